"""The adapters against drivers that only remember: what is sent, in which units and order, and when nothing is."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from arm_cases import DOWN, HOME, PERIOD, Recorder, armed

from pred_core.arm import orientation
from pred_core.arm.dry_run import DryRunArm
from pred_core.arm.limits import GuardConfig, bounds_of
from pred_core.arm.placement import Placement, rotate
from pred_core.arm.protocol import SetPoint
from pred_core.arm.step_check import StepCheck
from pred_core.arm.ur import UrArm, connect_ur
from pred_core.arm.xarm import XArm, connect_xarm
from pred_core.errors import ConfigError, InputError

# The base stands 0.5 m along x and is turned by 90 degrees: world (0.45, 0, 0.25) is base (0, 0.05, 0.25).
PLACEMENT = Placement(np.array([0.5, 0.0, 0.0]), orientation.from_rotation_vector((0.0, 0.0, math.pi / 2)))
HOME_IN_BASE = (0.0, 0.05, 0.25)
CONFIG = GuardConfig()


def at(place: tuple[float, float, float], velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SetPoint:
    """A set-point with the tool down."""
    return SetPoint(np.array(place), DOWN, np.array(velocity), np.zeros(3))


def test_frames_of_the_base() -> None:
    position, rotation = PLACEMENT.to_base(np.array(HOME), DOWN)
    assert position == pytest.approx(HOME_IN_BASE)
    back = PLACEMENT.to_world(position, rotation)
    assert back[0] == pytest.approx(HOME) and orientation.angle_between(back[1], DOWN) < 1e-12
    assert PLACEMENT.vector_to_base(np.array([1.0, 0.0, 0.0])) == pytest.approx((0.0, -1.0, 0.0))
    assert rotate(DOWN, np.array([0.0, 0.0, 1.0])) == pytest.approx((0.0, 0.0, -1.0))


def test_dry_run_is_where_it_was_told_to_be() -> None:
    arm = DryRunArm(np.array(HOME), DOWN)
    with pytest.raises(InputError, match="before the arm was enabled"):
        arm.command(at(HOME))
    arm.begin()
    arm.command(at((0.5, 0.1, 0.3)))
    assert arm.read().position == pytest.approx((0.5, 0.1, 0.3)) and arm.read().closed
    arm.stop()
    with pytest.raises(InputError, match="before the arm was enabled"):
        arm.command(at(HOME))


class UrCase:
    """A UrArm at HOME between two recorders; `receive.answers` can be changed during a test."""

    def __init__(self, **receive: Any) -> None:
        _, turned = PLACEMENT.to_base(np.array(HOME), DOWN)
        pose = [*HOME_IN_BASE, *orientation.rotation_vector(turned)]
        good = dict.fromkeys(("servoL", "servoStop", "setWatchdog", "kickWatchdog"), lambda *a: True)
        self.control = Recorder(
            **good,
            isProgramRunning=lambda: True,
            reuploadScript=lambda: True,
            stopScript=lambda: None,
            disconnect=lambda: None,
        )
        self.receive = Recorder(
            **{
                "isConnected": lambda: True,
                "getActualTCPPose": lambda: pose,
                "getActualQ": lambda: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
                "getRobotMode": lambda: 7,
                "isProtectiveStopped": lambda: False,
                "isEmergencyStopped": lambda: False,
                "disconnect": lambda: None,
                **receive,
            }
        )
        check = StepCheck(0.008, CONFIG.speed, CONFIG.angular_speed)
        self.arm = UrArm(self.control, self.receive, PLACEMENT, 0.008, check)


def test_ur_sends_servo_l_in_the_base_frame_and_kicks_the_watchdog() -> None:
    case = UrCase()
    reading = case.arm.read()
    assert reading.ready and reading.position == pytest.approx(HOME)
    assert orientation.angle_between(reading.rotation, DOWN) < 1e-12
    assert reading.joints["elbow"] == 0.3 and reading.closed is None
    case.arm.begin()
    case.arm.command(at((0.452, 0.0, 0.25)))
    assert case.control.names() == ["isProgramRunning", "setWatchdog", "servoL", "kickWatchdog"]
    assert case.control.last("setWatchdog") == (10.0,)
    pose, speed, acceleration, period, lookahead, gain = case.control.last("servoL")
    assert pose[:3] == pytest.approx((0.0, 0.048, 0.25))  # +2 mm in world x is -2 mm in base y
    assert np.linalg.norm(pose[3:]) == pytest.approx(math.pi)
    assert (speed, acceleration, period, lookahead, gain) == (0.0, 0.0, 0.008, 0.1, 300.0)
    case.arm.close()
    assert case.control.names()[-3:] == ["servoStop", "stopScript", "disconnect"]


def test_ur_refuses_what_it_would_have_to_race_for() -> None:
    case = UrCase()
    with pytest.raises(InputError, match="before the arm was enabled"):
        case.arm.command(at(HOME))
    case.arm.begin()
    for bad in ((0.4522, 0.0, 0.25), (math.nan, 0.0, 0.25)):  # 2.2 mm in 8 ms; 2.1 mm are allowed
        with pytest.raises(InputError, match="too far from the one before"):
            case.arm.command(at(bad))
    assert "servoL" not in case.control.names()


@pytest.mark.parametrize(
    ("trouble", "word"),
    [
        ({"isProtectiveStopped": lambda: True}, "protective stop"),
        ({"isEmergencyStopped": lambda: True}, "emergency stop"),
        ({"getRobotMode": lambda: 5}, "robot mode 5"),
    ],
)
def test_ur_never_releases_a_stop_by_itself(trouble: dict[str, Any], word: str) -> None:
    case = UrCase()
    case.arm.begin()
    case.receive.answers.update(trouble)
    with pytest.raises(InputError, match=word):
        case.arm.command(at(HOME))
    assert not case.arm.read().ready and case.arm.read().message.startswith(word)
    case.arm.stop()
    with pytest.raises(InputError, match=word):
        case.arm.begin()
    sent = set(case.control.names())  # the recorder answers nothing else: an unlock would have raised
    assert sent <= {"isProgramRunning", "setWatchdog", "servoStop"}


def test_ur_starts_its_script_again_or_says_so() -> None:
    case = UrCase()
    case.control.answers["isProgramRunning"] = lambda: False
    case.arm.begin()
    assert "reuploadScript" in case.control.names()
    case.control.answers["reuploadScript"] = lambda: False
    with pytest.raises(InputError, match="control script does not run"):
        case.arm.begin()
    case.control.answers["isProgramRunning"] = lambda: True
    for call, word in (("setWatchdog", "no watchdog"), ("servoL", "servoL was refused"), ("kickWatchdog", "kicked")):
        case.control.answers[call] = lambda *a: False
        with pytest.raises(InputError, match=word):
            case.arm.begin()
            case.arm.command(at(HOME))
        case.control.answers[call] = lambda *a: True

    def broken(*args: Any) -> bool:
        raise RuntimeError("socket closed")

    for call in ("servoL", "kickWatchdog", "isProgramRunning", "servoStop", "stopScript"):
        case = UrCase()
        case.control.answers[call] = broken
        with pytest.raises(InputError, match="ur: the driver failed; got socket closed"):
            case.arm.begin()
            case.arm.command(at(HOME))
            case.arm.close()
    with pytest.raises(InputError, match="connection lost"):
        UrCase(isConnected=lambda: False).arm.read()
    with pytest.raises(InputError, match="reports no pose"):
        UrCase(getActualTCPPose=lambda: [0.0, math.nan, 0.0, 0.0, 0.0, 0.0]).arm.read()


class XArmCase:
    """An XArm at HOME before a recorder."""

    def __init__(self, **changes: Any) -> None:
        # In the base frame, tool down, the tool's x axis along base -y: roll pi, yaw -90 degrees.
        pose = [0.0, 50.0, 250.0, math.pi, 0.0, -math.pi / 2]
        good = dict.fromkeys(
            ("motion_enable", "set_mode", "set_state", "set_reduced_tcp_boundary", "set_fence_mode"), lambda *a: 0
        )
        self.api = Recorder(
            **{
                **good,
                "vc_set_cartesian_velocity": lambda *a, **k: 0,
                "get_position": lambda is_radian: (0, pose),
                "get_servo_angle": lambda is_radian: (0, [0.1] * 7),
                "disconnect": lambda: None,
                "connected": True,
                "get_err_warn_code": lambda: (0, [0, 0]),
                "version_number": (2, 3, 0),
                **changes,
            }
        )
        self.arm = XArm(self.api, PLACEMENT, bounds_of(CONFIG), CONFIG.speed, CONFIG.angular_speed)


def test_xarm_speaks_millimetres_a_second_and_radians_with_a_dead_man() -> None:
    case = XArmCase()
    reading = case.arm.read()
    assert reading.position == pytest.approx(HOME) and len(reading.joints) == 7
    assert orientation.angle_between(reading.rotation, DOWN) < 1e-9
    case.arm.begin()
    starts = [c for c in case.api.names() if not c.startswith("get")]
    assert starts == ["set_reduced_tcp_boundary", "set_fence_mode", "motion_enable", "set_mode", "set_state"]
    assert case.api.last("set_mode") == (5,) and case.api.last("set_state") == (0,)
    # World x 0.2..0.7 is base y 0.3..-0.2, world y +-0.4 is base x +-0.4, z 0.02..0.6; 30 mm more to every side.
    assert case.api.last("set_reduced_tcp_boundary")[0] == pytest.approx([430, -430, 330, -230, 630, -10], abs=1)
    case.arm.command(at((0.451, 0.0, 0.25), (0.1, 0.0, 0.0)))
    speeds, radian, tool, duration = case.api.last("vc_set_cartesian_velocity")
    # 0.1 m/s and 4 / s x 1 mm = 0.104 m/s along world x: -104 mm/s along base y.
    assert speeds == pytest.approx([0.0, -104.0, 0.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert (radian, tool, duration) == (True, False, 0.1)
    case.arm.stop()
    assert case.api.last("vc_set_cartesian_velocity")[0] == [0.0] * 6 and case.api.last("set_state") == (4,)


def test_xarm_holds_its_own_speed_limit() -> None:
    case = XArmCase()
    case.arm.begin()
    case.arm.command(at((0.7, 0.0, 0.25), (0.25, 0.0, 0.0)))  # 0.25 m away: the pull alone would be 1 m/s
    assert np.linalg.norm(case.api.last("vc_set_cartesian_velocity")[0][:3]) == pytest.approx(300.0)  # 1.2 x 0.25 m/s
    with pytest.raises(InputError, match="not finite"):
        case.arm.command(at((math.nan, 0.0, 0.25)))


def test_xarm_never_clears_an_error() -> None:
    case = XArmCase()
    case.arm.begin()
    case.api.answers["get_err_warn_code"] = lambda: (0, [31, 0])
    case.api.answers["vc_set_cartesian_velocity"] = lambda *a, **k: 1  # what the SDK makes of an error
    assert not case.arm.read().ready and case.arm.read().message == "error 31"
    with pytest.raises(InputError, match="vc_set_cartesian_velocity was refused; got code 1"):
        case.arm.command(at(HOME))
    with pytest.raises(InputError, match="refused"):
        case.arm.stop()
    assert case.api.last("set_state") == (4,)  # halted all the same
    with pytest.raises(InputError, match="xarm: error 31. Clear it in Studio"):
        case.arm.begin()
    assert not {"clean_error", "clean_warn"} & set(case.api.names())


def test_xarm_refusals() -> None:
    with pytest.raises(InputError, match="no dead-man for velocities; got 1.7.9"):
        XArmCase(version_number=(1, 7, 9)).arm.begin()
    with pytest.raises(InputError, match="connection lost"):
        XArmCase(connected=False).arm.read()
    with pytest.raises(InputError, match="get_position was refused; got code -8"):
        XArmCase(get_position=lambda is_radian: (-8, [])).arm.read()
    with pytest.raises(InputError, match="gave no pose"):
        XArmCase(get_position=lambda is_radian: (0, [math.nan] * 6)).arm.read()
    for call in ("set_mode", "set_state", "set_fence_mode", "motion_enable", "set_reduced_tcp_boundary"):
        with pytest.raises(InputError, match=f"{call} was refused"):
            XArmCase(**{call: lambda *a: 9}).arm.begin()


@pytest.mark.parametrize("name", ["ur", "xarm"])
def test_a_driver_follows_the_guard_from_rest_to_rest(name: str) -> None:
    """Two seconds of the guard's set-points, then its ramp: the driver never has to refuse one."""
    case: UrCase | XArmCase = UrCase() if name == "ur" else XArmCase()
    guard = armed(CONFIG)
    case.arm.begin()
    for k in range(1, 250):
        now = k * PERIOD
        guard.command((0.45, min(0.002 * k, 0.3), 0.25), DOWN, now, now)
        if k == 180:
            guard.stop("test")
        setpoint = guard.tick(now)
        assert setpoint is not None
        case.arm.command(setpoint)
    assert guard.at_rest


def test_missing_drivers_and_controllers_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rtde_control", None)
    with pytest.raises(ConfigError, match="ur_rtde is not installed. pip install ur-rtde"):
        connect_ur("127.0.0.1", PLACEMENT, 0.008, StepCheck(0.008, 1.0, 1.0))
    monkeypatch.setitem(__import__("sys").modules, "xarm.wrapper", None)
    with pytest.raises(ConfigError, match="xArm SDK is not installed"):
        connect_xarm("127.0.0.1", PLACEMENT, bounds_of(CONFIG), 0.25, 1.0)

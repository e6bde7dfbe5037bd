"""The arm: follows a plan or commanded poses through the guard; a dry run unless told otherwise.

In: plan/trajectory or gripper/command. Out: gripper/pose, gripper/closed, joint_states, /diagnostics.
`~/enable` (SetBool) arms and disarms, `~/stop` (Trigger) latches a stop, `~/reset` (Trigger) clears a latched fault
and connects again to an arm whose connection was lost.
The node starts disarmed, and after a fault it moves only when a person has called reset and then enable.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NoReturn

import numpy as np
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from pred_core.arm import orientation
from pred_core.arm.disconnected import DisconnectedArm
from pred_core.arm.dry_run import DryRunArm
from pred_core.arm.follower import Follower
from pred_core.arm.guard import Guard, Mode
from pred_core.arm.limits import MOST_LIFETIME, GuardConfig, bounds_of
from pred_core.arm.placement import Placement
from pred_core.arm.plan_needs import LIFETIME
from pred_core.arm.plant import HOST, PATIENCE, PORT, STARTING, connect_plant
from pred_core.arm.protocol import Arm, Reading
from pred_core.arm.step_check import StepCheck
from pred_core.arm.ur import connect_ur
from pred_core.arm.xarm import connect_xarm
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE
from pred_core.config import setting
from pred_core.errors import ConfigError, InputError, PredError
from pred_ros import arm_messages, convert, qos, shell
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.shell import REFUSAL_SHOWN, REFUSED, Shell

LEVELS = {Mode.FAULT: ERROR, Mode.RAMPING: WARN}
AGAIN = "; when its cause is gone, call ~/reset, then ~/enable"  # what a fault asks for
ENDED = "the plan ended in motion (its last two poses differ) and no other came"  # why no set-points are asked for
ACTIVE = (Mode.HOLDING, Mode.MOVING, Mode.RAMPING)
OTHER_CLOCK = 1_000_000_000  # [ns] from the node's time: an arm's stamp farther off is not on the node's clock


@dataclass(frozen=True)
class ArmConfig(GuardConfig):
    """Parameters of the arm node: the limits, and which arm stands where."""

    arm: str = setting("dry_run", choices=("dry_run", "plant", "ur", "xarm"), doc="which arm")
    host: str = setting("", doc="address of the arm's controller; of a plant, this machine unless told otherwise")
    port: int = setting(PORT, low=1, high=65535, doc="of a plant's controller")
    source: str = setting("plan", choices=("plan", "command"), doc="follow plan/trajectory or gripper/command")
    lifetime: float = setting(LIFETIME, unit="s", low=0.1, high=MOST_LIFETIME, doc="age up to which a plan is followed")
    base_x: float = setting(0.0, unit="m", low=-5.0, high=5.0, doc="the arm's base in world")
    base_y: float = setting(0.0, unit="m", low=-5.0, high=5.0, doc="the arm's base in world")
    base_z: float = setting(0.0, unit="m", low=-5.0, high=5.0, doc="the arm's base in world")
    base_yaw: float = setting(0.0, unit="rad", low=-math.pi, high=math.pi, doc="the base's turn about world z")
    home_x: float = setting(0.45, unit="m", low=-3.0, high=3.0, doc="where a dry run begins")
    home_y: float = setting(0.0, unit="m", low=-3.0, high=3.0, doc="where a dry run begins")
    home_z: float = setting(0.25, unit="m", low=-3.0, high=3.0, doc="where a dry run begins")
    autostart: bool = setting(True, doc="configure and activate without a lifecycle manager")


def make_arm(config: ArmConfig, patience: float = STARTING, sleep: Callable[[float], None] = time.sleep) -> Arm:
    """The arm a configuration names; a plant that is started now has `patience` [s], spent in `sleep`.

    Raises: ConfigError, or InputError if its controller does not answer.
    """
    if config.arm == "dry_run":
        home = np.array([config.home_x, config.home_y, config.home_z])
        return DryRunArm(home, orientation.DOWN if config.tool_down else orientation.UP)
    if config.arm == "plant":
        return connect_plant(config.host or HOST, config.port, patience, sleep)
    if not config.host:
        raise ConfigError(f"parameter 'host' is empty, arm '{config.arm}' needs one", next_step="-p host:=192.168.1.2")
    base = np.array([config.base_x, config.base_y, config.base_z])
    placement = Placement(base, orientation.from_rotation_vector((0.0, 0.0, config.base_yaw)))
    bounds = bounds_of(config)
    if config.arm == "ur":
        check = StepCheck(bounds.period, config.speed, config.angular_speed)
        return connect_ur(config.host, placement, bounds.period, check)
    return connect_xarm(config.host, placement, bounds, config.speed, config.angular_speed)


class ArmNode(Shell):
    """One timer drives everything; nothing moves between its ticks."""

    NAME: ClassVar[str] = "arm"
    CONFIG: ClassVar[type] = ArmConfig

    def __init__(self) -> None:
        super().__init__()
        self._arm: Arm | None = None
        self._active = False
        self._following = False  # the arm was told to follow set-points
        self._closed: bool | None = None  # as published last
        self._measured = -1  # [ns] of the pose that was published last
        self._said: tuple[Mode, str] | None = None
        self._mentioned = False  # the headline is a refusal that is not about the mode
        self._broken = False  # the arm could not be read

    def setup(self) -> None:
        """Check the limits, connect, make the publishers and services."""
        config: ArmConfig = self.config
        self._guard = self._make_guard()
        self._follower = Follower(config, config.lifetime)
        if self._arm is None:
            self.report(OK, f"connecting to {config.arm}")
            self._arm = make_arm(config, sleep=self.sleep)
        self._pose_out = self.create_publisher(PoseArray, GRIPPER_POSE, qos.points_complete())
        self._closed_out = self.create_publisher(UInt8MultiArray, GRIPPER_CLOSED, qos.latched())
        self._joints_out = self.create_publisher(JointState, "joint_states", 10)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_service(Trigger, "~/reset", self._on_reset)
        limits = self._guard.bounds
        self.diagnostics.value("arm", config.arm)
        self.diagnostics.value("stops within [s]", f"{limits.stop_ticks * limits.period:.3f}")
        self.diagnostics.value("stops within [m]", f"{limits.stop_distance(config.speed):.3f}")

    def start(self) -> None:
        """Listen and tick; not armed yet."""
        if self._arm is None:  # active again after a pause
            self._guard, self._follower = self._make_guard(), Follower(self.config, self.config.lifetime)
            self._arm = make_arm(self.config, sleep=self.sleep)
        if self.config.source == "plan":
            self._heard: Any = self.create_subscription(
                MultiDOFJointTrajectory, arm_messages.PLAN, self._on_plan, qos.plans(), raw=True
            )
        else:
            self._heard = self.create_subscription(PoseArray, arm_messages.COMMAND, self._on_command, qos.command())
        self._active = True
        self._ticker = self.create_timer(self._guard.bounds.period, self._tick)

    def stop(self) -> None:
        """Come to rest within the limits, then let go of the arm."""
        if self._arm is None:
            return
        if self._active:
            self._active = False
            self.destroy_timer(self._ticker)
            self.destroy_subscription(self._heard)
            self._come_to_rest()
        try:
            self._arm.close()
        except InputError as error:
            self.report(ERROR, str(error))
        self._arm = None

    def changed(self, config: ArmConfig) -> None:
        """Nothing changes under a connected arm."""
        changed = [f.name for f in fields(config) if getattr(config, f.name) != getattr(self.config, f.name)]
        if changed and self._arm is not None:
            raise ConfigError(f"'{changed[0]}' cannot change while the arm is connected", next_step="Deactivate first")

    def heartbeat(self) -> None:
        """Counters of the guard; the flags again, for readers that came late and ask for new messages only."""
        if self._closed is not None:
            self._closed_out.publish(convert.closed_to_message(arm_messages.closed_flag(self._closed)))
        if self._arm is not None:
            for what, count in self._guard.counts.items():
                self.diagnostics.value(f"count: {what}", str(count))

    def _make_guard(self) -> Guard:
        return Guard(self.config, ENDED if self.config.source == "plan" else "no command")

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _on_plan(self, data: bytes) -> None:
        self.diagnostics.seen(arm_messages.PLAN)
        setpoint = self._guard.setpoint
        try:
            plan = arm_messages.bytes_to_plan(data, self.config)
            if setpoint is None or self._guard.mode not in ACTIVE:
                raise InputError(
                    f"a plan while {self._guard.line}", next_step="Call enable, then plan from where it is"
                )
            self._follower.accept(plan, (setpoint.position, setpoint.rotation), self._now())
        except PredError as error:
            self._refused("plans", str(error))
        else:
            self.diagnostics.count("plans")

    def _on_command(self, message: PoseArray) -> None:
        self.diagnostics.seen(arm_messages.COMMAND)
        try:
            stamp, position, rotation = arm_messages.message_to_command(message)
        except PredError as error:
            return self._refused("commands", str(error))
        line = self._guard.command(position, rotation, stamp, self._now())
        if line is None:
            self.diagnostics.count("commands")
        else:
            self._refused("commands", line)

    def _refused(self, what: str, line: str) -> None:
        self.diagnostics.count(f"{what} refused")
        self.diagnostics.value("last refusal", line)
        if self._guard.mode is not Mode.FAULT:
            self._mention(f"refused: {line}")

    def _mention(self, line: str) -> None:
        """The headline for a while; a fault stays one."""
        self.diagnostics.seen(REFUSED)
        self._mentioned = True
        self.report(ERROR if self._guard.mode is Mode.FAULT else WARN, line)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if not request.data:
            self._guard.disarm()
            self._follower.clear()
            response.success, response.message = True, self._guard.line
            return response
        try:
            self._enable()
        except InputError as error:
            response.success, response.message = False, str(error)
            self._mention(str(error))
        else:
            response.success, response.message = True, self._guard.line
        return response

    def _enable(self) -> None:
        if self._arm is None or not self._active:
            raise InputError("cannot enable: the node is not active", next_step="Activate it")
        reading = self._arm.read()
        if not reading.ready:
            raise InputError(f"cannot enable: {reading.message}", next_step="Clear it at the arm, then enable again")
        self._guard.arm(reading.position, reading.rotation)
        self._follower.clear()
        try:
            self._arm.begin()
        except InputError:
            self._guard.disarm()
            raise
        self._following = True

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._guard.stop("stopped by service")
        response.success, response.message = True, self._guard.line
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            if self._following and self._guard.mode is Mode.FAULT:
                raise InputError("cannot reset: still coming to rest", next_step="Try again in a second")
            if self._broken:
                self._connect_again()
            self._guard.reset()
            self._follower.clear()
        except InputError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, self._guard.line
        return response

    def _connect_again(self) -> None:
        """A new connection instead of a lost one, for the person who resets. Raises: InputError if nobody answers."""
        assert self._arm is not None
        with contextlib.suppress(InputError):
            self._arm.close()
        try:
            self._arm = make_arm(self.config, PATIENCE)
        except InputError as error:
            self._arm = DisconnectedArm(str(error))
            raise
        self._broken = False

    def _tick(self) -> None:
        now = self._now()
        reading = self._read(now)
        if reading is not None:
            self._ask(now)
            self._guard.measured(reading.position, reading.rotation)
        self._drive(now)
        if self._mentioned and (self.diagnostics.age(REFUSED) or 0.0) > REFUSAL_SHOWN:
            self._mentioned, self._said = False, None
        if (self._guard.mode, self._guard.line) != self._said:
            self._said = (self._guard.mode, self._guard.line)
            again = AGAIN if self._guard.mode is Mode.FAULT else ""
            self.report(WARN if self._guard.clipped else LEVELS.get(self._guard.mode, OK), self._guard.line + again)

    def _read(self, now: int) -> Reading | None:
        """Read and publish; None, and the arm is stopped, if it cannot be read or would not follow."""
        assert self._arm is not None  # the timer lives as long as the connection
        try:
            reading = self._arm.read()
        except InputError as error:
            self._broken = True
            self._lost(str(error))
            return None
        self._broken = False
        stamp = now if reading.stamp is None or abs(reading.stamp - now) > OTHER_CLOCK else reading.stamp
        if stamp != self._measured:  # the arm may be asked more often than it measures
            self._measured = stamp
            self._pose_out.publish(arm_messages.reading_to_pose(stamp, reading))
            if reading.joints:
                self._joints_out.publish(arm_messages.reading_to_joints(stamp, reading.joints))
        if reading.closed is not None and reading.closed != self._closed:
            self._closed = reading.closed
            self._closed_out.publish(convert.closed_to_message(arm_messages.closed_flag(reading.closed)))
        if not reading.ready and self._guard.mode in ACTIVE:
            self._lost(reading.message)
        return reading

    def _ask(self, now: int) -> None:
        """Pass the plan's pose, as far ahead as the guard lags behind, to the guard."""
        if self.config.source != "plan" or self._guard.mode not in ACTIVE:
            return
        if self._follower.done(now):
            self._guard.finish()
            self._follower.clear()
            return
        target = self._follower.target(now, self._guard.bounds.lag)
        if target is not None:
            line = self._guard.command(target[0], target[1], now, now)
            if line is not None:
                self.diagnostics.value("last refusal", line)

    def _drive(self, now: int) -> None:
        """One set-point to the arm; after a disarm or a fault, until it is at rest."""
        assert self._arm is not None
        before = self._guard.setpoint
        setpoint = self._guard.tick(now)
        if setpoint is None or setpoint is before or not self._following:
            return  # the same again would be a sudden halt for one period
        try:
            self._arm.command(setpoint)
            if self._guard.mode not in ACTIVE and self._guard.at_rest:
                self._following = False
                self._arm.stop()
        except InputError as error:
            self._lost(str(error))

    def _lost(self, line: str) -> None:
        """The arm cannot be driven any more: latch the fault, tell it to stop, send nothing."""
        assert self._arm is not None
        self._guard.stop(line)
        self._follower.clear()
        if self._following:
            self._following = False
            try:
                self._arm.stop()
            except InputError as error:
                self.diagnostics.value("stop", str(error))

    def _come_to_rest(self) -> None:
        """Ramp down on a clock of its own: simulated time may stand still by now."""
        self._guard.disarm()
        period = self._guard.bounds.period
        now = self._now()
        for k in range(self._guard.bounds.stop_ticks + 4):
            if not self._following:
                return
            time.sleep(period)
            self._drive(now + round((k + 1) * period * 1e9))


def main() -> NoReturn:
    """Entry point of `ros2 run pred_ros arm`."""
    shell.main(ArmNode)


if __name__ == "__main__":
    main()

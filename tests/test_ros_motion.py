"""`pred_motion`: a proposed motion is executed by the arm node, or the arm's refusal is what it ends with."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from test_arm_node import DOWN, HOME, World, arm_world

from pred_core.arm.approach import TimedPoses, with_approach
from pred_core.arm.guard import Mode
from pred_core.arm.plan_file import read_motion
from pred_core.errors import ConfigError, InputError
from pred_ros.commands import Interrupts

BEGIN = HOME + (0.0, 0.06, 0.02)
REST = 0.4  # [s]
WAY = 0.1  # [m] along x, there and back, with (1 - cos)/2 over 2 s: 0.157 m/s at most


def motion_file(path: Path) -> Path:
    """A motion from BEGIN, as `pred diagnose` writes them."""
    times = 0.1 * np.arange(21)
    places = [BEGIN + (0.5 * WAY * (1.0 - math.cos(math.pi * t)), 0.0, 0.0) for t in times]
    rows = [*zip(times.tolist(), places, strict=True), (2.1, places[-1])]
    points = [
        {"time_from_start": t, "transforms": [{"translation": p.tolist(), "rotation": list(DOWN)}]} for t, p in rows
    ]
    trajectory = {"frame_id": "world", "joint_names": ["gripper0"], "points": points}
    path.write_text(yaml.safe_dump({"format": 1, "start": {"rest_first": REST}, "trajectory": trajectory}))
    return path


def executed(world: World, *arguments: str, interrupt_at: float = math.inf) -> tuple[int, str, str]:
    """`pred_motion` beside the arm node, which goes on meanwhile: exit code, what it printed, its last line."""
    command = [sys.executable, "-m", "pred_ros.motion", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        moved = None
        end = time.monotonic() + 60.0
        while process.poll() is None and time.monotonic() < end:
            world.bench.executor.spin_once(timeout_sec=0.05)
            moved = moved or (time.monotonic() if world.guard.mode is Mode.MOVING else None)
            if moved is not None and time.monotonic() - moved > interrupt_at:
                process.send_signal(signal.SIGINT)
                interrupt_at = math.inf
        out, err = process.communicate(timeout=10.0)
    finally:
        process.kill()
    return process.returncode, out, err.strip().splitlines()[-1] if err.strip() else ""


def test_the_way_to_the_beginning() -> None:
    """0.1 m at 0.05 m/s at most: pi/2 of 2 s; 0.5 s of rest; then the motion. No step of it is faster."""
    motion = TimedPoses(np.array([0.0, 1.0]), np.array([[0.1, 0.0, 0.3], [0.1, 0.0, 0.4]]), np.tile(DOWN, (2, 1)))
    whole = with_approach(motion, np.array([0.0, 0.0, 0.3]), DOWN, 0.05, 0.5)
    speed = np.linalg.norm(np.diff(whole.position, axis=0), axis=1) / np.diff(whole.times)
    assert speed[:-1].max() <= 0.05 and (np.diff(whole.times) > 0.0).all()
    assert whole.times[-1] == pytest.approx(math.pi + 0.5 + 1.0)
    assert whole.position[0].tolist() == [0.0, 0.0, 0.3] and whole.position[-3] == pytest.approx(motion.position[0])


def test_a_proposed_motion_is_executed(tmp_path: Path) -> None:
    """From where the arm is to the beginning, the rest, the motion, in this order; the arm waits at its end."""
    file = motion_file(tmp_path / "next_motion.yaml")
    with arm_world(lifetime=20.0) as world:
        assert world.enable().success
        world.poses.clear()
        code, out, line = executed(world, str(file), "--approach", "0.1")
        assert (code, line) == (0, ""), (out, line)
        seen = np.array([[p.poses[0].position.x, p.poses[0].position.y, p.poses[0].position.z] for p in world.poses])
        there = np.linalg.norm(seen - BEGIN, axis=1) < 1e-3
        assert there.any() and np.abs(seen[: int(there.argmax()), 0] - HOME[0]).max() < 1e-3
        assert seen[:, 0].max() == pytest.approx(HOME[0] + WAY, abs=5e-3)  # the guard rounds the turn
        assert world.place() == pytest.approx(BEGIN, abs=1e-3) and world.guard.mode is Mode.HOLDING


def test_what_the_arm_refuses_is_the_last_line(tmp_path: Path) -> None:
    file = motion_file(tmp_path / "next_motion.yaml")
    with arm_world() as world:
        code, _, line = executed(world, str(file))
        assert code == 2 and "Call enable" in line
        assert world.enable().success
        code, _, line = executed(world, str(file))
        assert code == 2 and "plan is too long" in line and "lifetime:=" in line
        assert world.place() == pytest.approx(HOME)
    code, _, line = executed_alone(str(tmp_path / "none.yaml"))
    assert code == 2 and "none.yaml" in line


def executed_alone(*arguments: str) -> tuple[int, str, str]:
    """`pred_motion` without an arm node."""
    done = subprocess.run([sys.executable, "-m", "pred_ros.motion", *arguments], capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr.strip().splitlines()[-1]


def _moved(point: dict, times: float) -> dict:
    return {**point["transforms"][0], "translation": [times * v for v in point["transforms"][0]["translation"]]}


BAD_MOTIONS: dict[str, tuple[Callable[[dict, int], dict], str]] = {
    "times that fall": (lambda p, k: {"time_from_start": 3.0 - p["time_from_start"]}, "times do not increase"),
    "a time that is no number": (lambda p, k: {"time_from_start": math.nan if k == 5 else 0.1 * k}, "not finite"),
    "millimetres": (lambda p, k: {"transforms": [_moved(p, 1e3)]}, "out of reach at point"),
    "no rotation": (lambda p, k: {"transforms": [_moved(p, 1.0) | {"rotation": [0.0] * 4}]}, "without unit norm"),
}


@pytest.mark.parametrize(("change", "said"), BAD_MOTIONS.values(), ids=BAD_MOTIONS)
def test_a_motion_that_no_arm_could_follow_is_refused_before_anything_is_sent(
    change: Callable[[dict, int], dict], said: str, tmp_path: Path
) -> None:
    values = yaml.safe_load(motion_file(tmp_path / "good.yaml").read_text())
    values["trajectory"]["points"] = [p | change(p, k) for k, p in enumerate(values["trajectory"]["points"])]
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(InputError, match=f"bad.yaml: plan.*{said}"):
        read_motion(tmp_path / "bad.yaml")
    values["start"]["rest_first"] = math.inf
    (tmp_path / "rests.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match="rests.yaml: not a motion"):
        read_motion(tmp_path / "rests.yaml")


def test_a_way_too_long_for_one_plan_is_not_sent(tmp_path: Path) -> None:
    values = yaml.safe_load(motion_file(tmp_path / "far.yaml").read_text())
    for point in values["trajectory"]["points"]:
        point["transforms"][0]["translation"][0] += 5.0
    (tmp_path / "far.yaml").write_text(yaml.safe_dump(values))
    with arm_world(lifetime=600.0) as world:
        assert world.enable().success
        code, _, line = executed(world, str(tmp_path / "far.yaml"), "--approach", "0.005")
        assert code == 2 and "too long for one plan" in line and world.guard.counts.total() == 0


def test_a_warning_does_not_end_it(tmp_path: Path) -> None:
    """Whoever watches the motion must not leave while the arm moves: at the edge of its box it goes on."""
    edge = HOME[0] + WAY - 0.002  # the motion's far end is 2 mm outside, which the arm accepts, and holds there
    with arm_world(lifetime=30.0, x_high=edge) as world:
        assert world.enable().success
        code, out, line = executed(world, str(motion_file(tmp_path / "next_motion.yaml")), "--approach", "0.1")
        assert (code, line) == (0, ""), (out, line)
        assert "held at a limit" in out and world.place() == pytest.approx(BEGIN, abs=1e-3)


def test_an_error_on_the_way_stops_the_arm(tmp_path: Path) -> None:
    file = motion_file(tmp_path / "next_motion.yaml")
    with arm_world(lifetime=30.0) as world:
        assert world.enable().success
        wrong = DiagnosticArray(status=[DiagnosticStatus(name="/arm", level=DiagnosticStatus.ERROR, message="broken")])
        out = world.bench.world.create_publisher(DiagnosticArray, "/diagnostics", 10)
        timer = world.bench.world.create_timer(0.1, lambda: world.guard.mode is Mode.MOVING and out.publish(wrong))
        code, _, line = executed(world, str(file), "--approach", "0.02")
        timer.cancel()
        assert code == 2 and "broken" in line
        world.bench.until(lambda: world.guard.mode is Mode.FAULT and world.guard.at_rest, "it has stopped")


def test_an_interrupt_waits_until_nobody_is_in_the_client_library() -> None:
    """Raised in the conversion of a message it came out as a RuntimeError. After it, Ctrl-C is as it was."""
    before = signal.getsignal(signal.SIGINT)
    with Interrupts() as interrupts:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            with pytest.raises(KeyboardInterrupt):
                interrupts.check()
            interrupts.check()
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt), Interrupts():
        signal.raise_signal(signal.SIGINT)  # nobody has checked: it is not lost


def test_an_interrupt_stops_the_arm(tmp_path: Path) -> None:
    file = motion_file(tmp_path / "next_motion.yaml")
    with arm_world(lifetime=30.0) as world:
        assert world.enable().success
        code, _, line = executed(world, str(file), "--approach", "0.02", interrupt_at=0.5)
        assert code == 130 and "interrupted" in line
        world.bench.until(lambda: world.guard.mode is Mode.FAULT and world.guard.at_rest, "it has stopped")
        assert np.linalg.norm(world.place() - BEGIN) > 0.02  # on the way

"""The arm node as a dry run: plans and commands in, poses out, services, and what it says on /diagnostics."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from arm_cases import broken, measure
from geometry_msgs.msg import PoseArray, Quaternion, Transform, Vector3
from rclpy.serialization import serialize_message
from ros_bench import Bench, bench_of
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from pred_core.arm.dry_run import DryRunArm
from pred_core.arm.guard import Mode
from pred_core.arm.protocol import Reading, SetPoint
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import stamp_of
from pred_core.errors import InputError
from pred_ros import arm_messages, arm_node, convert, qos
from pred_ros.arm_node import ArmConfig, ArmNode
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.processes import free_domain, node_command, node_environment

HOME = np.array([0.45, 0.0, 0.25])
DOWN = (0.0, 1.0, 0.0, 0.0)
MEASURES = 50_000_000  # [ns]


class World:
    """What surrounds the arm."""

    def __init__(self, bench: Bench):
        self.bench, self.node = bench, bench.node
        self.poses: list[PoseArray] = []
        self.closed: list[UInt8MultiArray] = []
        self.joints: list[JointState] = []
        world = bench.world
        world.create_subscription(PoseArray, "gripper/pose", self.poses.append, qos.points_complete())
        world.create_subscription(UInt8MultiArray, "gripper/closed", self.closed.append, qos.latched())
        world.create_subscription(JointState, "joint_states", self.joints.append, 10)
        self.plan_out = world.create_publisher(MultiDOFJointTrajectory, "plan/trajectory", qos.command())
        self.command_out = world.create_publisher(PoseArray, "gripper/command", qos.command())
        bench.until(lambda: len(self.poses) > 2 and self.closed, "poses of a disarmed arm")

    @property
    def guard(self) -> Any:
        """The node's guard."""
        return self.node._guard  # type: ignore[attr-defined]

    def now(self) -> int:
        """ROS time [ns]."""
        return int(self.bench.world.get_clock().now().nanoseconds)

    def place(self) -> np.ndarray:
        """The newest gripper/pose [m]."""
        p = self.poses[-1].poses[0].position
        return np.array([p.x, p.y, p.z])

    def ask(self, service: str, kind: type, request: Any) -> Any:
        """Call a service of the node."""
        client = self.bench.world.create_client(kind, f"/arm/{service}")
        self.bench.until(client.service_is_ready, "the service")
        answer = client.call_async(request)
        self.bench.until(answer.done, "an answer")
        return answer.result()

    def enable(self, on: bool = True) -> Any:
        """~/enable."""
        return self.ask("enable", SetBool, SetBool.Request(data=on))

    def trigger(self, service: str) -> Any:
        """~/stop or ~/reset."""
        return self.ask(service, Trigger, Trigger.Request())

    def wait(self, seconds: float) -> None:
        """Let it run."""
        end = time.monotonic() + seconds
        self.bench.until(lambda: time.monotonic() > end, "time passes")

    def send_plan(self, way: np.ndarray, seconds: float, rest: bool = True, frame: str = "world") -> None:
        """A straight plan from here by `way` [m], of ten points, from now on."""
        here, points = self.place(), []
        moments = [(0.1 * (k + 1) * seconds, 0.1 * (k + 1)) for k in range(10)]
        for moment, share in [(0.0, 0.0), *moments] + ([(1.2 * seconds, 1.0)] if rest else []):
            x, y, z = (here + share * way).tolist()
            w, i, j, k = DOWN
            pose = Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(w=w, x=i, y=j, z=k))
            point = MultiDOFJointTrajectoryPoint(transforms=[pose])
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(moment * 1e9), 10**9)
            points.append(point)
        header = convert.header_at(self.now(), frame)
        self.plan_out.publish(MultiDOFJointTrajectory(header=header, joint_names=["gripper0"], points=points))

    def send_command(self, place: np.ndarray, age: float = 0.0) -> None:
        """One commanded pose."""
        stamp = self.now() - round(age * 1e9)
        self.command_out.publish(convert.pose_to_message(PoseFrame(stamp, place[None], np.array([DOWN]))))


@contextmanager
def arm_world(**parameters: object) -> Iterator[World]:
    """An active arm node; 50 Hz, so that a busy machine keeps up."""
    values = {"rate": "50.0", **{k: str(v) for k, v in parameters.items()}}
    with bench_of(ArmNode, values, feeds=False) as bench:
        yield World(bench)


def test_a_plan_is_followed_and_the_arm_waits_at_its_end() -> None:
    with arm_world() as world:
        assert world.closed[-1].data.tolist() == [1] and not world.joints
        world.send_plan(np.array([0.05, 0.0, 0.0]), 0.5)
        world.bench.until(lambda: world.bench.says(WARN, "refused: a plan while not armed"), "a refusal")
        assert world.place() == pytest.approx(HOME)
        answer = world.enable()
        assert answer.success, answer.message
        world.send_plan(np.array([0.05, 0.02, 0.0]), 0.5)
        world.bench.until(lambda: world.guard.mode is Mode.MOVING, "it follows")
        world.bench.until(lambda: world.guard.mode is Mode.HOLDING and world.guard.at_rest, "it waits")
        world.wait(0.7)  # longer than the watchdog: nothing is expected of it any more
        assert world.guard.mode is Mode.HOLDING
        assert world.place() == pytest.approx(HOME + (0.05, 0.02, 0.0), abs=1e-9)
        stamps = np.array([stamp_of(p) for p in world.poses])
        assert (np.diff(stamps) > 0).all() and world.poses[-1].header.frame_id == "world"
        assert world.bench.says(OK, "armed") and world.bench.says(OK, "following")


def test_a_planner_that_dies_stops_the_arm_and_only_people_start_it_again() -> None:
    with arm_world() as world:
        assert world.enable().success
        world.send_plan(np.array([0.06, 0.0, 0.0]), 0.5, rest=False)
        world.bench.until(lambda: world.bench.says(WARN, "stopping"), "the ramp")
        world.bench.until(lambda: world.bench.says(ERROR, "the plan ended in motion", "call ~/reset"), "the latch")
        world.bench.until(lambda: world.guard.at_rest, "at rest, also when the machine is busy")
        world.wait(0.1)
        stopped = world.place()
        world.send_plan(np.array([0.02, 0.0, 0.0]), 0.5)
        world.wait(0.3)
        assert world.place() == pytest.approx(stopped)
        assert not world.enable().success  # a fault is reset first
        assert world.trigger("reset").success and world.guard.mode is Mode.DISARMED
        assert world.enable().success
        world.send_plan(np.array([0.02, 0.0, 0.0]), 0.3)
        world.bench.until(lambda: world.place()[0] > stopped[0] + 0.0199, "it moves again")


def test_stop_disable_and_reset() -> None:
    with arm_world() as world:
        assert world.enable().success
        world.send_plan(np.array([0.1, 0.0, 0.0]), 1.0)
        world.bench.until(lambda: world.place()[0] > 0.46, "it moves")
        assert world.trigger("stop").success
        world.bench.until(lambda: world.bench.says(ERROR, "stopped by service"), "it says so")
        world.bench.until(lambda: world.guard.at_rest and world.trigger("reset").success, "at rest")
        assert world.enable().success
        assert world.enable(False).message == "disarmed"
        world.wait(0.1)
        assert world.guard.mode is Mode.DISARMED and world.enable().success


def test_commands_are_followed_and_bad_ones_named() -> None:
    with arm_world(source="command", z_high=0.3) as world:
        assert world.enable().success
        goal = HOME + (0.0, 0.03, 0.0)
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            world.send_command(goal)
            world.wait(0.02)
        assert world.place() == pytest.approx(goal, abs=1e-6)
        far = world.place() + (0.0, 0.0, 0.2)  # led there in steps, above the workspace of 0.3 m
        for share in np.linspace(0.0, 1.0, 40):
            world.send_command(goal + share * (far - goal))
            world.wait(0.03)
        world.bench.until(lambda: world.bench.says(WARN, "held at a limit: workspace"), "it is held, and says so")
        world.send_command(goal, age=0.3)
        world.bench.until(lambda: world.bench.says(WARN, "old"), "a late command is named")
        world.send_command(np.array([np.nan, 0.0, 0.0]))
        world.bench.until(lambda: world.bench.says(ERROR, "not finite"), "NaN is a fault")


def test_bad_plans_are_refused_with_one_line() -> None:
    with arm_world() as world:
        assert world.enable().success
        world.send_plan(np.array([0.01, 0.0, 0.0]), 0.5, frame="base_link")
        world.bench.until(lambda: world.bench.says(WARN, "another frame", "'base_link'"), "the frame")
        world.send_plan(np.array([0.5, 0.0, 0.0]), 0.2)
        world.bench.until(lambda: world.bench.says(WARN, "plan jumps after point 0"), "the jump")
        world.send_plan(np.array([0.0, 0.0, -0.24]), 2.0)
        world.bench.until(lambda: world.bench.says(WARN, "leaves the workspace"), "under the table")
        world.send_plan(np.array([0.1, 0.0, 0.0]), 4.0)
        world.bench.until(lambda: world.bench.says(WARN, "too long", "lifetime:=5.0"), "it would be cut off")
        world.plan_out.publish(MultiDOFJointTrajectory(header=convert.header_at(world.now()), joint_names=["a", "b"]))
        world.bench.until(lambda: world.bench.says(WARN, "one gripper an arm"), "two grippers")
        world.plan_out.publish(MultiDOFJointTrajectory(header=convert.header_at(world.now()), joint_names=["a"]))
        world.bench.until(lambda: world.bench.says(WARN, "too few points"), "an empty plan")
        assert world.guard.mode is Mode.HOLDING and world.place() == pytest.approx(HOME)


class Troubled(DryRunArm):
    """A dry run that can be in a protective stop, or lose its connection."""

    trouble = ""
    lost = False
    calls: list[str] = []

    def read(self) -> Reading:
        """As the drivers of real arms do."""
        if self.lost:
            raise InputError("connection lost")
        found = super().read()
        return Reading(found.position, found.rotation, not self.trouble, self.trouble or "ok", True, {"j1": 0.5})

    def stop(self) -> None:
        """Remembered."""
        self.calls.append("stop")
        super().stop()


class Measuring(DryRunArm):
    """A dry run that measures every 50 ms and says when."""

    def __init__(self, clock: Callable[[], int]):
        super().__init__(HOME, DOWN)
        self.clock, self.off = clock, 0

    def read(self) -> Reading:
        """As the plant does."""
        stamp = self.clock() // MEASURES * MEASURES + self.off
        return dataclasses.replace(super().read(), stamp=stamp)


def test_a_plan_too_long_to_be_read_does_not_keep_the_arm_waiting() -> None:
    """50,000 points took the node 1.3 s, in which it sent no set-point and heard no stop."""
    points = [MultiDOFJointTrajectoryPoint(transforms=[Transform(rotation=Quaternion(x=1.0, w=0.0))])] * 50_000
    long = MultiDOFJointTrajectory(joint_names=["gripper0"], points=points)
    long.header.frame_id = "world"
    data = serialize_message(long)
    begin = time.process_time()
    with pytest.raises(InputError, match="too long to be read while the arm moves; got .* allowed: 5,000 points"):
        arm_messages.bytes_to_plan(data, ArmConfig())
    assert time.process_time() - begin < 0.01
    with arm_world() as world:
        assert world.enable().success
        world.plan_out.publish(long)
        world.bench.until(lambda: world.bench.says(WARN, "refused: plan/trajectory: too long"), "the refusal")


def test_a_refusal_is_the_headline_for_a_while_and_a_fault_stays_one() -> None:
    with arm_world() as world:
        assert world.enable().success
        world.send_plan(np.array([2.0, 0.0, 0.0]), 0.5)
        world.bench.until(lambda: world.bench.says(WARN, "refused: plan"), "the refusal")
        world.bench.statuses.clear()
        world.bench.until(lambda: world.bench.says(OK, "armed, waiting"), "what the arm does")
        assert world.trigger("stop").success
        world.bench.until(lambda: world.bench.says(ERROR, "stopped by service"), "the fault")
        assert not world.enable().success
        world.bench.until(lambda: world.bench.says(ERROR, "cannot arm"), "still an error")
        world.bench.statuses.clear()
        world.bench.until(lambda: world.bench.says(ERROR, "stopped by service"), "the fault again")
        assert not any(s.level in (OK, WARN) for s in world.bench.statuses)


def test_poses_bear_the_time_of_their_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each measurement is published once, with its own stamp; a stamp of another clock is not believed."""
    arm = Measuring(time.time_ns)
    monkeypatch.setattr(arm_node, "make_arm", lambda config, sleep: arm)
    with arm_world() as world:
        world.poses.clear()
        world.wait(0.5)
        stamps = [stamp_of(p) for p in world.poses]
        assert len(stamps) > 3 and all(s % MEASURES == 0 for s in stamps) and len(set(stamps)) == len(stamps)
        arm.off = 3_600_000_000_000
        world.wait(0.2)
        world.poses.clear()
        world.wait(0.3)
        assert world.poses and all(abs(stamp_of(p) - world.now()) < 1_000_000_000 for p in world.poses)


@pytest.mark.parametrize("how", ["protective stop", "connection lost"])
def test_a_troubled_arm_is_stopped_at_once(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = Troubled(HOME, DOWN)
    monkeypatch.setattr(arm_node, "make_arm", lambda config, sleep: arm)
    with arm_world() as world:
        world.bench.until(lambda: bool(world.joints), "joint_states")
        assert world.joints[-1].name == ["j1"] and world.joints[-1].position.tolist() == [0.5]
        assert world.enable().success
        arm.calls = []
        world.send_plan(np.array([0.1, 0.0, 0.0]), 1.0)
        world.bench.until(lambda: world.guard.mode is Mode.MOVING, "it moves")
        arm.trouble, arm.lost = ("", True) if how == "connection lost" else (how, False)
        world.bench.until(lambda: world.bench.says(ERROR, how), "it says so")
        assert arm.calls == ["stop"]
        arm.trouble, arm.lost = "", False
        world.wait(0.3)
        assert arm.calls == ["stop"] and world.guard.mode is Mode.FAULT  # nothing comes back by itself


def test_reset_connects_again_to_a_lost_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plant was started anew: the person who resets gets a new connection; while nobody answers, reset says so."""
    first, second = Troubled(HOME, DOWN), Troubled(HOME, DOWN)
    answers: list[Troubled] = [first]

    def connect(config: ArmConfig, patience: float = 0.0, sleep: object = None) -> Troubled:
        if not answers:
            raise InputError("plant: nobody at 127.0.0.1:7654")
        return answers.pop()

    monkeypatch.setattr(arm_node, "make_arm", connect)
    with arm_world() as world:
        world.bench.until(lambda: bool(world.joints), "joint_states")
        assert world.enable().success
        first.lost = True
        world.bench.until(lambda: world.guard.mode is Mode.FAULT, "it is noticed")
        refused = world.trigger("reset")
        assert not refused.success and "nobody at" in refused.message and world.guard.mode is Mode.FAULT
        answers.append(second)
        assert world.trigger("reset").success
        world.wait(0.1)  # the ticks read the new one
        assert world.guard.mode is Mode.DISARMED and world.enable().success
        world.wait(0.1)
        assert world.guard.mode is Mode.HOLDING


def test_a_configuration_that_cannot_be_ends_the_process_with_one_line() -> None:
    environment = node_environment(free_domain())
    for parameters, code, word in (
        ({"arm": "ur"}, 2, "'host' is empty"),
        ({"x_low": 0.9}, 2, "box is empty"),
        ({"speed": 100.0}, 2, "speed"),
    ):
        done = subprocess.run(
            node_command("arm", parameters), env=environment, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == code and word in done.stderr.strip().splitlines()[-1], done.stderr


def test_ctrl_c_ends_an_arm_that_waits_for_its_plant() -> None:
    process = subprocess.Popen(
        node_command("arm", {"arm": "plant", "port": 9}), env=node_environment(free_domain()),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert "connecting" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=10)  # it would wait 30 s for a plant
        assert process.returncode == 0 and said == ""
    finally:
        process.kill()


class Remembering(DryRunArm):
    """A dry run that remembers its set-points."""

    def __init__(self) -> None:
        super().__init__(HOME, DOWN)
        self.seen: list[SetPoint] = []
        self.closes = 0

    def command(self, setpoint: SetPoint) -> None:
        """Remembered."""
        self.seen.append(setpoint)
        super().command(setpoint)

    def close(self) -> None:
        """Counted."""
        self.closes += 1
        super().close()


def test_a_node_that_is_told_to_end_ramps_down_first(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = Remembering()
    monkeypatch.setattr(arm_node, "make_arm", lambda config, sleep: arm)
    with arm_world() as world:
        assert world.enable().success
        world.send_plan(np.array([0.1, 0.0, 0.0]), 0.6)
        world.bench.until(lambda: bool(arm.seen) and arm.seen[-1].velocity[0] > 0.1, "it moves")
        bounds, before = world.guard.bounds, len(arm.seen)
        world.node.stop()
        assert arm.closes == 1 and not arm.seen[-1].velocity.any() and arm.seen[-1].position[0] < 0.55
        assert 2 < len(arm.seen) - before <= bounds.stop_ticks + 4
        assert not broken(measure(arm.seen, world.node.config))

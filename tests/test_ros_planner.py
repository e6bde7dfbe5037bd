"""The planner node over real topics: a loop that reaches its goal, services, and how it answers bad input."""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import torch
from live_world import COUNT, make_twin
from plan_cases import DOWN, Rigid
from ros_bench import Bench, bench_of
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

from pred_core.arm.follower import Follower, Plan
from pred_core.arm.limits import GuardConfig
from pred_core.bag.grippers import PoseFrame
from pred_core.errors import InputError
from pred_core.plan import plan as planning
from pred_core.plan.latency import Observation
from pred_core.types import State
from pred_ros import arm_messages, convert, planner_messages, qos
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.planner_node import PlannerNode
from pred_ros.processes import free_domain, node_command, node_environment

HOME = np.array([0.45, 0.0, 0.25])
MOVE = np.array([0.06, 0.08, 0.05])  # [m]
IDS = np.arange(COUNT, dtype=np.uint32)
LINE = np.column_stack((0.05 * np.arange(COUNT), np.zeros((COUNT, 2))))
FROM_REST = 0.5 * 1.6 * 0.02**2 + 1e-6  # [m] in the first 20 ms, at 1.6 m/s^2
CELL_ROPE = Path(__file__).parents[1] / "config" / "twins" / "cell_rope"
SETTINGS = """
motion: {horizon: 1.0, knots: 5, speed: 0.2}
search: {samples: 32, chunk: 16, iterations: 4, frames: 4}
"""


class RigidPlanner(PlannerNode):
    """The node with an object that moves rigidly with its gripper."""

    MAKE_DYNAMICS = staticmethod(lambda twin, scene, device: Rigid(period=0.05))

    def __init__(self) -> None:
        super().__init__()
        self.planned: list[tuple[int, planning.Plan, int]] = []  # a plan, [ns] before and after it was looked for

    def _replan(self, seen: Observation) -> None:
        before = self._now()
        super()._replan(seen)
        plan = self._session.in_force
        if plan is not None and (not self.planned or self.planned[-1][1] is not plan):
            self.planned.append((before, plan, self._now()))


class World:
    """An arm that follows its plans exactly, as the arm node does, and what is seen of a rigid line it holds."""

    def __init__(self, bench: Bench):
        self.bench = bench
        self.messages: list[MultiDOFJointTrajectory] = []
        self.plans: list[Plan] = []
        self.arrivals: list[int] = []  # [ns]
        self.refused: list[str] = []
        self.follower = Follower(GuardConfig(), lifetime=30.0)
        self.following = True
        world = bench.world
        world.create_subscription(MultiDOFJointTrajectory, "plan/trajectory", self._on_plan, qos.plans())
        self.state_out = world.create_publisher(PointCloud2, "state/points", qos.points_complete())
        self.goal_out = world.create_publisher(PointCloud2, "goal/points", qos.latched())
        self.moved = np.zeros(3)
        self.places: list[np.ndarray] = []  # as published
        bench.until(lambda: self.state_out.get_subscription_count() >= 1, "the node listens")

    def now(self) -> int:
        return int(self.bench.world.get_clock().now().nanoseconds)

    def _on_plan(self, message: MultiDOFJointTrajectory) -> None:
        self.messages.append(message)
        self.arrivals.append(self.now())
        plan = arm_messages.message_to_plan(message, GuardConfig())  # raises for one with a jump
        self.plans.append(plan)
        try:
            self.follower.accept(plan, (HOME + self.moved, tuple(DOWN[0])), self.arrivals[-1])
        except InputError as error:
            self.refused.append(str(error))

    def place(self, stamp: int) -> np.ndarray:
        """Where the gripper is."""
        told = self.follower.target(stamp, 0.0)
        if self.following and told is not None:
            self.moved = told[0] - HOME
        return HOME + self.moved

    def see(self, stamp: int | None = None, position: np.ndarray | None = None, pose: bool = True) -> None:
        """Publish the pose and the state of one instant."""
        stamp = self.now() if stamp is None else stamp
        here = self.place(stamp)
        self.places.append(here)
        if pose:
            self.bench.pose_out.publish(convert.pose_to_message(PoseFrame(stamp, here[None], DOWN)))
        points = torch.tensor(here + LINE if position is None else position, dtype=torch.float32)
        held = torch.full((len(points),), -1, dtype=torch.int32)
        held[0] = 0
        cloud = convert.make_cloud if position is not None and not np.isfinite(position).all() else None
        if cloud is not None:
            columns = dict(zip(("x", "y", "z"), points.numpy().T, strict=True))
            zeros = {k: np.zeros(len(points)) for k in ("vx", "vy", "vz")}
            layout = {**dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), "f4"), "id": "u4", "held": "i4"}
            message = cloud(stamp, layout, {**columns, **zeros, "id": IDS, "held": held.numpy()})
        else:
            ids = np.arange(len(points), dtype=np.uint32)
            message = convert.state_to_cloud(stamp, ids, State(points, torch.zeros_like(points), held))
        self.state_out.publish(message)

    def live(self, condition: Any, what: str, limit: float = 60.0) -> None:
        """Publish at about 30 Hz until the condition holds."""
        due = [0.0]

        def tick() -> bool:
            if time.monotonic() >= due[0]:
                due[0] = time.monotonic() + 0.033
                self.see()
            return bool(condition())

        self.bench.until(tick, what, limit)

    def goal(self, points: np.ndarray) -> None:
        self.goal_out.publish(planner_messages.goal_to_cloud(self.now(), points))

    def ask(self, service: str, kind: type, request: Any) -> Any:
        client = self.bench.world.create_client(kind, f"/planner/{service}")
        self.live(client.service_is_ready, "the service")
        answer = client.call_async(request)
        self.live(answer.done, "an answer")
        return answer.result()

    def resting(self, place: np.ndarray) -> int:
        """How many plans begin at a place at rest."""
        at = [np.linalg.norm(p.position[0] - place) < 1e-6 for p in self.plans]
        return sum(
            bool(there) and np.linalg.norm(p.position[1] - p.position[0]) < FROM_REST
            for there, p in zip(at, self.plans, strict=True)
        )

    def enable(self, on: bool = True) -> Any:
        return self.ask("enable", SetBool, SetBool.Request(data=on))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("planner")
    (folder / "settings.yaml").write_text(SETTINGS)
    return {"twin": str(make_twin(folder / "twin")), "settings": str(folder / "settings.yaml")}


@contextmanager
def world_of(files: dict[str, str], **parameters: str) -> Iterator[World]:
    values = {**files, "budget": "0.2", **parameters}
    with bench_of(RigidPlanner, values, feeds=False) as bench:
        yield World(bench)


def test_loop_reaches_the_goal_with_plans_the_arm_accepts(files: dict[str, str]) -> None:
    with world_of(files, reached="0.006") as world:
        world.goal(HOME + LINE + MOVE)
        world.see()
        assert world.enable().success
        world.live(lambda: world.bench.says(OK, "goal reached"), "the goal is reached")
        counts = world.bench.node._session.counts
        world.bench.until(lambda: len(world.plans) == counts.plans, "every plan that was sent")
        assert len(world.plans) >= 2 and all(p.ends_at_rest for p in world.plans)
        assert not world.refused
        assert np.linalg.norm(world.moved - MOVE) < 0.012
        assert all(m.header.frame_id == "world" and list(m.joint_names) == ["gripper0"] for m in world.messages)
        # A point every 20 ms at 0.2 m/s, straight in between: off the curve by a dt^2 / 8 < 0.1 mm.
        fresh = [k for k, off in enumerate(joins(world.plans)) if off > 5e-4]
        # Only what was announced does not continue the plans before: on a machine that stops for a quarter of a second
        # this arm hears of a plan too late and is given up.
        assert len(fresh) <= counts.fresh - 1 <= counts.off_track
        for k in fresh:
            begin, places = world.plans[k + 1].position[:2], np.array(world.places)
            assert np.linalg.norm(places - begin[0], axis=-1).min() < 1e-6
            assert np.linalg.norm(begin[1] - begin[0]) < FROM_REST


def joins(plans: list[Plan]) -> list[float]:
    """[m] from where the plans before would have brought the arm to the beginning of each but the first."""
    found = []
    for k in range(1, len(plans)):
        due = plans[k].begin
        # Sent in this order: what would begin later than a newer plan never does.
        told = [p for i, p in enumerate(plans[:k]) if all(p.begin < q.begin for q in plans[i + 1 : k])]
        begun = [p for p in told if p.begin <= due]
        found.append(float(np.linalg.norm((begun or told)[-1 if begun else 0].at(due)[0] - plans[k].at(due)[0])))
    return found


def test_nothing_is_sent_before_enable_and_stop_latches(files: dict[str, str]) -> None:
    with world_of(files) as world:
        world.goal(HOME + LINE + MOVE)
        world.live(lambda: world.bench.says(OK, "call ~/enable"), "the node is ready")
        assert not world.plans
        world.enable()
        world.live(lambda: len(world.plans) >= 2, "plans")
        assert world.ask("stop", Trigger, Trigger.Request()).success
        # What it sent last; a stop that comes after all motion has ended needs no plan.
        world.bench.until(lambda: world.plans[-1].times[-1] <= 0.43, "a plan that comes to rest", 60.0)
        last = world.plans[-1]
        # Within two knots of 0.2 s, plus the point that repeats the last pose.
        assert last.ends_at_rest and last.times[-1] <= 0.4 + 0.03
        world.live(lambda: world.bench.says(WARN, "stopped; call ~/reset"), "it says so")
        assert not world.enable().success
        count = len(world.plans)
        assert world.ask("reset", Trigger, Trigger.Request()).success and world.enable().success
        world.live(lambda: len(world.plans) > count, "plans again")


def test_a_plan_begins_after_it_is_sent(files: dict[str, str]) -> None:
    with world_of(files) as world:
        world.goal(HOME + LINE + MOVE)
        world.see()
        world.enable()
        node = world.bench.node
        world.live(lambda: len(node.planned) >= 4, "plans")
        # Budget 0.2 s and margin 0.05 s from when planning began, rounded to whole periods of 0.05 s after the state.
        least, most = 225_000_000, 275_000_000
        assert all(before + least <= plan.start <= after + most for before, plan, after in node.planned[:4])
        # One that was found in time is there in time, unless the machine stops just then.
        world.live(
            lambda: sum(t < p.begin for t, p in zip(world.arrivals, world.plans, strict=True)) >= 4, "plans in time"
        )


def test_an_arm_that_does_not_follow_is_planned_from_where_it_is(files: dict[str, str]) -> None:
    with world_of(files, off_track="0.01") as world:
        world.following = False
        world.goal(HOME + LINE + MOVE)
        world.see()
        world.enable()
        counts = world.bench.node._session.counts
        world.live(lambda: counts.off_track >= 1 and counts.fresh >= 2, "the plans are given up, another one begins")
        # The arm never left: plans that begin there at rest are the first one and the new one.
        world.live(lambda: world.resting(HOME) >= 2, "a plan from where it is")
        assert any("given up" in s.message for s in world.bench.statuses if s.level == WARN)


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        (np.zeros((0, 3)), ("goal is empty",)),
        (HOME + LINE + [2.0, 0.0, 0.0], ("out of reach",)),
        (np.full((3, 3), np.nan), ("goal", "not finite")),
    ],
)
def test_an_unusable_goal_is_refused_and_a_good_one_helps(
    files: dict[str, str], goal: np.ndarray, words: tuple[str, ...]
) -> None:
    with world_of(files, enabled="true") as world:
        world.goal(goal)
        world.live(lambda: world.bench.says(ERROR, *words), "an error that says why")
        assert not world.plans and world.bench.node.exit_code is None
        world.live(lambda: world.bench.says(WARN, "no usable goal"), "a warning that stays, once the error is told")
        world.goal(HOME + LINE + MOVE)
        world.live(lambda: world.plans, "a plan to the good goal")


def test_a_refused_goal_ends_planning_to_the_old_one(files: dict[str, str]) -> None:
    with world_of(files, enabled="true") as world:
        world.goal(HOME + LINE + MOVE)
        world.live(lambda: world.plans, "a plan")
        cloud = planner_messages.goal_to_cloud(world.now(), LINE)
        cloud.header.frame_id = "base_link"
        world.goal_out.publish(cloud)
        world.live(lambda: world.bench.says(ERROR, "goal/points", "base_link"), "the frame is named")
        assert not world.bench.node._session.has_goal


def test_bad_states_are_refused_with_the_reason(files: dict[str, str]) -> None:
    with world_of(files, enabled="true") as world:
        world.goal(HOME + LINE + MOVE)
        broken = HOME + LINE
        broken[2] = math.nan
        world.see()
        world.see(position=broken)
        world.bench.until(lambda: world.bench.says(ERROR, "ids [2] are not finite"), "NaN is named")
        world.see(position=1e3 * (HOME + LINE))
        world.bench.until(lambda: world.bench.says(ERROR, "state/points", "millimetres?"), "the unit is named")
        for stamp in (0, 10_000_000):  # one pose alone would be out of line
            world.see(stamp=world.now() - 2_000_000_000 + stamp)
        world.bench.until(lambda: world.bench.says(ERROR, "state is too old"), "age is named")
        world.see(stamp=world.now() + 300_000_000, pose=False)
        world.bench.until(lambda: world.bench.says(ERROR, "no gripper/pose at the stamp"), "the missing pose is named")
        cloud = planner_messages.goal_to_cloud(world.now(), LINE)
        cloud.header.frame_id = "camera"
        world.goal_out.publish(cloud)
        world.bench.until(lambda: world.bench.says(ERROR, "goal/points", "camera"), "the frame is named")
        assert world.bench.node.exit_code is None


def test_grippers_that_change_in_number_are_refused_until_reset(files: dict[str, str]) -> None:
    """2 grippers at t, 3 at t + 20 ms, a state between them: no traceback, and no pose made up out of both."""
    with world_of(files) as world:
        world.goal(HOME + LINE + MOVE)
        stamp = world.now()

        def pose(at: int, count: int) -> None:
            place = HOME + np.array([[0.0, 0.1, 0.0]]) * np.arange(count)[:, None]
            frame = PoseFrame(at, place, np.repeat(DOWN, count, axis=0))
            world.bench.pose_out.publish(convert.pose_to_message(frame))

        world.bench.until(lambda: world.bench.pose_out.get_subscription_count() >= 1, "the node listens")
        pose(stamp, 2)
        pose(stamp + 20_000_000, 3)
        world.bench.until(
            lambda: world.bench.says(ERROR, "number of grippers changed", "got 3", "2 as before"), "the change is named"
        )
        world.see(stamp=stamp + 10_000_000, pose=False)
        assert world.ask("reset", Trigger, Trigger.Request()).success and world.enable().success
        world.live(lambda: world.plans, "plans with one gripper, after a reset")
        assert world.bench.node.exit_code is None


def test_a_gripper_far_from_the_object_or_its_workspace_is_not_planned_for(files: dict[str, str]) -> None:
    with world_of(files, enabled="true") as world:
        world.goal(HOME + LINE + MOVE)
        for up, words in ((5.0, "gripper 0 is outside its workspace"), (0.25, "far from what it is said to hold")):
            line = HOME + LINE
            world.moved = np.array([0.0, 0.0, up])

            def said(line: np.ndarray = line, words: str = words) -> bool:
                world.see(position=line)
                return world.bench.says(ERROR, words)

            world.bench.until(said, "a line that says so")
        assert not world.plans
        world.moved = np.zeros(3)
        world.live(lambda: world.plans, "a plan once it is there")


def test_an_error_that_is_over_does_not_stay_the_headline(files: dict[str, str]) -> None:
    """One pose of another frame while the node has planned and nothing new comes to plan from."""
    with world_of(files, enabled="true", max_age="60.0", pose_gap="1.0") as world:
        world.goal(HOME + LINE + MOVE)
        world.live(lambda: world.plans, "a plan")
        stranger = convert.pose_to_message(PoseFrame(world.now(), HOME[None], DOWN))
        stranger.header.frame_id = "base_link"
        world.bench.pose_out.publish(stranger)
        world.bench.until(lambda: world.bench.says(ERROR, "refused", "base_link"), "the frame is named")
        world.bench.until(lambda: world.bench.statuses[-1].level == WARN, "the error is over", 10.0)
        assert "no new plan" in world.bench.statuses[-1].message


def test_silence_is_said(files: dict[str, str]) -> None:
    with world_of(files, enabled="true") as world:
        world.goal(HOME + LINE + MOVE)
        world.live(lambda: world.plans, "a plan")
        world.bench.until(lambda: world.bench.says(ERROR, "state/points stopped"), "silence is an error")


def test_a_state_of_another_twin_ends_the_node(files: dict[str, str], capsys: pytest.CaptureFixture) -> None:
    with world_of(files, enabled="true") as world:
        world.goal(HOME + LINE + MOVE)
        world.see(position=np.concatenate((HOME + LINE, HOME + LINE + 0.1)))
        world.bench.until(lambda: world.bench.node.exit_code == 2, "the node gives up")
        assert "do not match the twin" in capsys.readouterr().err


def test_markers_only_when_asked_for(files: dict[str, str]) -> None:
    with world_of(files, enabled="true", markers="true") as world:
        seen: list[MarkerArray] = []
        world.bench.world.create_subscription(MarkerArray, "/planner/markers", seen.append, qos.latched())
        world.goal(HOME + LINE + MOVE)
        world.live(lambda: seen, "markers")
        spaces = [m.ns for m in seen[-1].markers]
        assert spaces.count("plan") == 1 and spaces.count("samples") > 16
    with world_of(files) as world:
        assert world.bench.world.count_publishers("/planner/markers") == 0


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({}, "parameter 'twin' is empty"),
        ({"twin": "/nowhere"}, "not a twin"),
        ({"budgets": 0.1}, "did you mean 'budget'?"),
        ({"twin": str(CELL_ROPE), "device": "cuda"}, "parameter 'device'; got cuda; allowed: cpu"),
    ],
)
def test_a_process_with_bad_parameters_ends_with_one_line(
    tmp_path: Path, parameters: dict[str, Any], words: str
) -> None:
    environment = node_environment(free_domain()) | {"CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        node_command("planner", parameters), env=environment, capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    lines = [line for line in done.stderr.strip().splitlines() if line.startswith("planner:")]
    assert len(lines) == 1 and words in lines[0]

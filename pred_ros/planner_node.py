"""The planner: from state/points and the measured gripper to the motion that brings the object to goal/points.

In: state/points, gripper/pose, goal/points (latched). Out: plan/trajectory, ~/markers of sampled motions if asked for.
It replans with every new state there is time for. `~/enable` (SetBool) starts and ends planning; `~/stop` (Trigger)
sends a motion that comes to rest at once and latches; `~/reset` (Trigger) clears the latch and forgets old plans, and
how many grippers there were.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, NoReturn

import numpy as np
import torch
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

from pred_core.bag.wire import GOAL_POINTS, GRIPPER_POSE, PLAN_TRAJECTORY, STATE_POINTS
from pred_core.config import setting
from pred_core.dynamics import Dynamics
from pred_core.errors import ConfigError, PredError, TwinError
from pred_core.plan.gripper_poses import GripperPoses
from pred_core.plan.latency import Observation
from pred_core.plan.plan import Plan
from pred_core.plan.planner import Planner
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.session import Session, Timing
from pred_core.plan.task import load_settings, make_planner, planning_dynamics, scene_with_slot, with_gap
from pred_core.springmass.device import check_device
from pred_core.twin import Twin
from pred_core.types import Array, Scene
from pred_ros import convert, planner_messages, qos, shell
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.shell import Shell

SAMPLES_SHOWN = 64  # motions in the markers


@dataclass(frozen=True)
class PlannerNodeConfig(Timing):
    """Parameters of the planner node."""

    twin: str = setting("", doc="folder of the twin")
    settings: str = setting("", doc="YAML file of motion, search, costs and slot; empty: the defaults")
    gap: float = setting(0.0, unit="m", low=0.0, high=1.0, doc="between the posts of the slot; 0: as in the settings")
    enabled: bool = setting(False, doc="plan without waiting for ~/enable")
    device: str = setting("cpu", choices=("cpu", "cuda"), doc="where motions are simulated")
    pose_gap: float = setting(0.05, unit="s", low=0.001, high=1.0, doc="farthest gripper pose from a state's stamp")
    spacing: float = setting(0.02, unit="s", low=0.002, high=0.5, doc="between two points of a plan")
    markers: bool = setting(False, doc="publish sampled motions on ~/markers")
    seed: int = setting(0, low=0, high=2**31 - 1, doc="of the sampled motions")
    threads: int = setting(1, low=1, high=64, doc="torch threads")
    autostart: bool = setting(True, doc="configure and activate without a lifecycle manager")


class PlannerNode(Shell):
    """Callbacks keep the newest messages; one worker thread owns the `Session` and plans."""

    NAME: ClassVar[str] = "planner"
    CONFIG: ClassVar[type] = PlannerNodeConfig
    MAKE_DYNAMICS: ClassVar[Callable[[Twin, Scene, str], Dynamics]] = staticmethod(planning_dynamics)

    def __init__(self) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="planning")
        self._worker: Future[None] | None = None
        self._changed = threading.Condition()
        self._state: tuple[int, PointCloud2] | None = None  # arrival number, newest state
        self._goal: PointCloud2 | None = None
        self._poses = GripperPoses()
        self._ending = self._enabled = self._latched = self._stop_asked = self._reset_asked = False

    def setup(self) -> None:
        """Load the twin and the settings, make publishers and services."""
        config: PlannerNodeConfig = self.config
        if not config.twin:
            raise TwinError(
                "parameter 'twin' is empty", next_step="ros2 run pred_ros planner --ros-args -p twin:=FOLDER"
            )
        check_device(config.device, "parameter 'device'")
        torch.set_num_threads(config.threads)
        self._twin = Twin.load(Path(config.twin))
        settings = load_settings(config.settings)
        self._settings = with_gap(settings, config.gap) if config.gap > 0.0 else settings
        scene = scene_with_slot(self._twin.scene, self._settings)
        self._dynamics = type(self).MAKE_DYNAMICS(self._twin, scene, config.device)
        self._plan_out = self.create_publisher(MultiDOFJointTrajectory, PLAN_TRAJECTORY, qos.plans())
        self._markers_out = self.create_publisher(MarkerArray, "~/markers", qos.latched()) if config.markers else None
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.diagnostics.value("fixtures", str(len(scene.fixtures)))
        self.report(WARN, f"twin {config.twin} loaded; waiting for {GOAL_POINTS}, {STATE_POINTS}, {GRIPPER_POSE}")

    def start(self) -> None:
        """Listen, and plan in a worker."""
        config: PlannerNodeConfig = self.config
        self._ways: list[Array] = []
        self._costs: list[float] = []
        self._session = Session(self._make_planner, config, self._now, clock=self.seconds)
        self._state, self._goal, self._ending = None, None, False
        self._poses.clear()
        self._enabled, self._latched = config.enabled, False
        self._inputs = [
            self.create_subscription(PointCloud2, GOAL_POINTS, self._on_goal, qos.latched()),
            self.create_subscription(PoseArray, GRIPPER_POSE, self._on_pose, qos.poses_live()),
            self.create_subscription(PointCloud2, STATE_POINTS, self._on_state, qos.points_live()),
        ]
        self._watch = self.create_timer(0.05, lambda: self.check_worker(self._worker))
        self._worker = self._pool.submit(self._work)  # last: what fails before leaves no thread behind

    def stop(self) -> None:
        """End the worker; what was sent is carried out to its stop."""
        if self._worker is None:
            return
        self._worker = None
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self.destroy_timer(self._watch)
        self._wake(_ending=True)
        self._pool.shutdown(wait=True)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="planning")

    def changed(self, config: PlannerNodeConfig) -> None:
        """Everything is fixed while the node runs."""
        changed = [f.name for f in fields(config) if getattr(config, f.name) != getattr(self.config, f.name)]
        if changed and self._worker is not None:
            raise ConfigError(f"'{changed[0]}' cannot change while the node is active", next_step="Deactivate first")

    def heartbeat(self) -> None:
        """Judge ages; the worker reports what it does."""
        if self._worker is None:
            return
        counts = self._session.counts
        for name, count in vars(counts).items():
            self.diagnostics.value(f"count: {name}", str(count))
        if self.refusal:
            self.report(ERROR, self.refusal)
            return
        for topic in (GOAL_POINTS, STATE_POINTS, GRIPPER_POSE):
            age = self.diagnostics.age(topic)
            if age is None or (topic != GOAL_POINTS and age > self.config.max_age):
                since = "never came" if age is None else f"stopped {age:.1f} s ago"
                self.report(WARN if age is None else ERROR, f"{topic} {since}: no planning")
                return
        if self._latched:
            self.report(WARN, "stopped; call ~/reset, then ~/enable")
        elif not self._enabled:
            self.report(OK, "ready; call ~/enable to plan")
        elif self._session.reached:
            self.report(OK, f"goal reached: {1e3 * (self._session.distance or 0.0):.1f} mm")
        elif not self._session.has_goal:
            self.report(WARN, f"no usable goal; publish another one on {GOAL_POINTS}")
        elif self.diagnostics.level == ERROR:  # it is over, and nothing new was planned
            self.report(WARN, "enabled; no new plan")

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _make_planner(self, goal: Array) -> Planner:
        watch = self._keep_ways if self.config.markers else None
        return make_planner(
            self._twin, goal, self._settings, self.config.seed, dynamics=self._dynamics, clock=self.seconds, watch=watch
        )

    def _on_goal(self, message: PointCloud2) -> None:
        self.diagnostics.seen(GOAL_POINTS)
        self._wake(_goal=message)

    def _on_state(self, message: PointCloud2) -> None:
        self.diagnostics.seen(STATE_POINTS)
        number = self.diagnostics.count(f"messages on {STATE_POINTS}")
        self._wake(_state=(number, message))

    def _on_pose(self, message: PoseArray) -> None:
        self.take(GRIPPER_POSE, self._add_pose, message)

    def _add_pose(self, message: PoseArray) -> None:
        pose = convert.message_to_pose(message)
        with self._changed:
            self._poses.add(pose)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data and self._latched:
            response.success, response.message = False, "stopped; call ~/reset first"
            return response
        self._wake(_enabled=bool(request.data), _stop_asked=not request.data)
        response.success, response.message = True, "planning" if request.data else "not planning; coming to rest"
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._wake(_enabled=False, _latched=True, _stop_asked=True)
        response.success, response.message = True, "coming to rest; ~/reset clears this"
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._changed:
            self._poses.clear()
        self._wake(_latched=False, _reset_asked=True)
        response.success, response.message = True, "old plans forgotten; ~/enable plans again"
        return response

    def _wake(self, **changes: object) -> None:
        with self._changed:
            for name, value in changes.items():
                setattr(self, name, value)
            self._changed.notify()

    # Below: the worker thread. It alone touches the Session.

    def _work(self) -> None:
        last = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._has_work(last))  # noqa: B023
                if self._ending:
                    return
                goal, self._goal = self._goal, None
                stop, self._stop_asked = self._stop_asked, False
                reset, self._reset_asked = self._reset_asked, False
                state = self._state if self._enabled else None
            try:
                with torch.no_grad():
                    if stop:
                        self._send(self._session.stop())
                    if reset:
                        self._session.reset()
                    if goal is not None:
                        self._session.clear_goal()  # also where the new one is refused
                        self._session.set_goal(planner_messages.cloud_to_goal(goal))
                    if state is not None and state[0] != last and self._session.has_goal:
                        last = state[0]
                        self._replan(self._observation(state[1]))
            except TwinError:
                raise
            except PredError as error:
                self.refuse(error)

    def _has_work(self, last: int) -> bool:
        fresh = self._enabled and self._state is not None and self._state[0] != last
        ready = fresh and (self._session.has_goal or self._goal is not None)
        return self._ending or self._stop_asked or self._reset_asked or self._goal is not None or ready

    def _observation(self, cloud: PointCloud2) -> Observation:
        """The state with the gripper pose of its stamp. Raises: InputError, BagError, TwinError for other ids."""
        stamp, ids, state = convert.cloud_to_state(cloud, STATE_POINTS)
        if not np.array_equal(ids, self._twin.body.id):
            raise TwinError("the particle ids of state/points do not match the twin", got=f"{len(ids)} ids",
                            allowed=f"{len(self._twin.body.id)} ids",
                            next_step="Give predictor and planner the same twin")  # fmt: skip
        with self._changed:
            position, rotation = self._poses.at(stamp, self.config.pose_gap)
        seen = Observation(stamp, state, position, rotation)
        seen.check(self._twin.body.count)
        return seen

    def _replan(self, seen: Observation) -> None:
        self._ways, self._costs = [], []
        since = time.monotonic()
        plan = self._session.replan(seen)
        seconds = time.monotonic() - since  # of computing; the plan's own are on the clock of the deadline
        if self._session.distance is not None:
            self.diagnostics.value("distance to the goal [mm]", f"{1e3 * self._session.distance:.1f}")
        if plan is None:
            if self._session.waiting:
                off = f"{1e3 * self._session.off:.0f} mm off its plan when last given up"
                self.report(WARN, f"waiting until the arm rests; {off}")
            return
        with self._changed:
            if not self._enabled or self._ending:  # stopped meanwhile
                return
        self._session.commit(plan)
        self._send(plan)
        rate = plan.motions * plan.steps / max(seconds, 1e-9)
        self.diagnostics.value("planning [s]", f"{seconds:.3f}")
        self.diagnostics.value("motions tried", str(plan.motions))
        self.diagnostics.value("frames simulated a second", f"{rate:.0f}")
        self.diagnostics.value("cost, standing still", f"{plan.cost:.4g}, {plan.still:.4g}")
        if not self.refusal:
            self.report(OK, "planning")

    def _send(self, plan: Plan | None) -> None:
        if plan is None:
            return
        self._plan_out.publish(planner_messages.plan_to_message(plan, self.config.spacing))
        if self._markers_out is not None:
            best = plan.points(self.config.spacing)[1][:, 0]
            self._markers_out.publish(planner_messages.plan_to_markers(plan.start, self._ways, self._costs, best))

    def _keep_ways(self, rollouts: Rollouts, costs: Array) -> None:
        """The first gripper's way in the newest samples."""
        ways = rollouts.grip.position[:, :, 0].double().cpu().numpy()
        stride = max(1, len(ways) // 25)
        self._ways = ([ways[::stride, k] for k in range(ways.shape[1])] + self._ways)[:SAMPLES_SHOWN]
        self._costs = (costs.tolist() + self._costs)[:SAMPLES_SHOWN]


def main() -> NoReturn:
    """Entry point of `ros2 run pred_ros planner`."""
    shell.main(PlannerNode)


if __name__ == "__main__":
    main()

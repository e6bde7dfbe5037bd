"""The predictor: loads a twin, takes tracker/points and the measured gripper, publishes what comes next.

In: tracker/points, gripper/pose, gripper/closed. Out: state/points (at the newest pose), prediction/points
(`horizon` later). `~/reset` (Trigger) starts anew from the next tracker frames. `mode`: the model alone from a measured
start (what the offline evaluation does), or an estimate that the tracks correct all the time (what a robot needs).
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NoReturn

import numpy as np
import torch
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import Trigger

from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, PREDICTION_POINTS, STATE_POINTS, TRACKER_POINTS
from pred_core.cli.settings import parse_held
from pred_core.config import setting, to_mapping
from pred_core.dynamics import Dynamics
from pred_core.errors import ConfigError, DivergenceError, PredError, TwinError
from pred_core.estimate.config import EstimatorConfig
from pred_core.live.following import Follower
from pred_core.live.prediction import Predictor
from pred_core.live.prediction_records import Rules
from pred_core.twin import Twin
from pred_ros import convert, qos, shell
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.shell import Shell

KEPT = 8  # newest messages that survive an overload
COUNTS_SHOWN = ("runs", "steps", "interpolated", "unused_poses", "gaps", "jumps", "dropped_frames", "dropped_poses")
OVERLOAD_SHOWN = 5.0  # [s] how long dropped messages do


@dataclass(frozen=True)
class PredictorConfig:
    """Parameters of the predictor."""

    twin: str = setting("", doc="folder of the twin")
    held: str = setting("", doc="particle:gripper pairs, e.g. '0:0 1:1'; empty: the twin's, else by distance")
    horizon: float = setting(0.0, unit="s", low=0.0, high=5.0, doc="predicted beyond the newest gripper pose")
    mode: str = setting("open_loop", choices=("open_loop", "estimate"), doc="model alone, or corrected by the tracks")
    correct: str = setting("none", choices=("none", "tracks"), doc="in open loop: restart from every measured frame")
    noise: float = setting(0.001, unit="m", low=1e-6, high=0.1, doc="of a track at confidence 1; estimate only")
    push: float = setting(
        0.6, unit="m/s^2", low=0.0, high=100.0, doc="what the model gets wrong; more follows the tracks closer"
    )
    stop_after: float = setting(2.0, unit="s", low=0.01, high=600.0, doc="without tracks; then no state is published")
    max_gap: float = setting(
        0.1, unit="s", low=0.001, high=10.0, doc="longest hole in gripper/pose; beyond it, no prediction"
    )
    overload: str = setting(
        "newest", choices=("newest", "queue"), doc="when too slow: restart at newest data, or keep all"
    )
    max_backlog: float = setting(0.5, unit="s", low=0.01, high=60.0, doc="wait of a message that counts as too slow")
    wait_for: int = setting(0, low=0, high=64, doc="readers of prediction/points to wait for before subscribing")
    threads: int = setting(1, low=1, high=64, doc="torch threads")
    autostart: bool = setting(True, doc="configure and activate without a lifecycle manager")


def held_of(config: PredictorConfig) -> dict[int, int] | None:
    """Particle id -> gripper; None: not told. Raises: ConfigError."""
    return parse_held(config.held, "parameter 'held'") if config.held.strip() else None


def check(config: PredictorConfig) -> None:
    """Raise ConfigError for what does not go together."""
    held_of(config)
    if config.mode == "estimate" and config.correct != "none":
        raise ConfigError("parameter 'correct'", got=repr(config.correct), allowed="none where mode is estimate")


def load_dynamics_of(twin: Twin) -> Dynamics:
    """The Dynamics a twin describes. Imported late: it pulls in the simulator."""
    from pred_core.pred import load_dynamics

    return load_dynamics(twin)


class PredictorNode(Shell):
    """Messages go through an inbox to one worker thread, which owns the `Predictor`."""

    NAME: ClassVar[str] = "predictor"
    CONFIG: ClassVar[type] = PredictorConfig
    MAKE_DYNAMICS: ClassVar[Callable[[Twin], Dynamics]] = staticmethod(load_dynamics_of)

    def __init__(self) -> None:
        super().__init__()
        self._inbox: queue.SimpleQueue[tuple[float, Callable[[], None]] | None] = queue.SimpleQueue()
        self._waited = 0.0  # [s] the message that is worked on, from its arrival
        self._worker: Future[None] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="prediction")
        self._inputs: list[Subscription] = []
        self._latched: Subscription | None = None  # reader of what was said of the gripper before
        self._closed: NDArray[np.bool_] | None = None
        self._overload = ""
        self._stopping = False

    def setup(self) -> None:
        """Load the twin."""
        config: PredictorConfig = self.config
        if not config.twin:
            raise TwinError(
                "parameter 'twin' is empty", next_step="ros2 run pred_ros predictor --ros-args -p twin:=FOLDER"
            )
        check(config)
        torch.set_num_threads(config.threads)
        self._twin = Twin.load(Path(config.twin))
        self._ids = self._twin.body.id
        held = held_of(config)
        if held is not None and (unknown := sorted(set(held) - set(self._ids.tolist()))):
            raise TwinError("parameter 'held' names particles the twin does not have", got=unknown[:5])
        self._dynamics = type(self).MAKE_DYNAMICS(self._twin)
        self._held = dict(self._twin.meta.held) or None if held is None else held
        origin = "parameter" if held is not None else "twin"
        told = "by distance to a closed gripper" if self._held is None else f"{self._held} ({origin})"
        self.get_logger().info(f"held particles and their grippers: {told}")
        self._state_out = self.create_publisher(PointCloud2, STATE_POINTS, qos.points_complete())
        self._prediction_out = self.create_publisher(PointCloud2, PREDICTION_POINTS, qos.points_complete())
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.report(WARN, f"twin {config.twin} loaded; waiting for {TRACKER_POINTS} and {GRIPPER_POSE}")

    def start(self) -> None:
        """Begin: a fresh Predictor, a worker, and subscriptions once enough readers listen."""
        config: PredictorConfig = self.config
        rules = Rules(max_gap=config.max_gap, horizon=config.horizon, correct=config.correct)
        self._predictor: Predictor | Follower
        if config.mode == "estimate":
            trust = EstimatorConfig(noise=config.noise, push=config.push, stop_after=config.stop_after)
            self._predictor = Follower(
                self._dynamics, self._twin.body, self._held, rules, self._twin.calibration, trust,
                dict(self._twin.meta.levers),
            )  # fmt: skip
        else:
            self._predictor = Predictor(self._dynamics, self._ids, self._held, rules, self._twin.calibration)
        self._inbox = queue.SimpleQueue()
        self._stopping = False
        self._starter = self.create_timer(0.02, self._subscribe_when_heard)
        self._watch = self.create_timer(0.05, lambda: self.check_worker(self._worker))
        self._worker = self._pool.submit(self._work)  # last: what fails before leaves no thread behind

    def stop(self) -> None:
        """End the worker; what waits in the inbox is not predicted any more."""
        if self._worker is None:
            return
        self._worker = None
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        for timer in (self._starter, self._watch):
            self.destroy_timer(timer)
        self._inputs, self._latched = [], None
        self._stopping = True
        self._predictor.cancel()
        self._inbox.put(None)
        self._pool.shutdown(wait=True)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="prediction")

    def changed(self, config: PredictorConfig) -> None:
        """Everything but the thresholds is fixed while the node runs."""
        check(config)
        fixed = [n for n in to_mapping(config) if n != "max_backlog" and getattr(config, n) != getattr(self.config, n)]
        if fixed and self._worker is not None:
            raise ConfigError(
                f"'{fixed[0]}' cannot change while the node is active", next_step="Deactivate the node first"
            )

    def heartbeat(self) -> None:
        """Judge ages and counters."""
        if self._worker is None:
            return
        if self._inputs and self._latched is None and self._closed is None and qos.is_latched(self, GRIPPER_CLOSED):
            self._latched = self.create_subscription(
                UInt8MultiArray, GRIPPER_CLOSED, self._on_closed_before, qos.latched()
            )
            self._inputs.append(self._latched)
        for name in COUNTS_SHOWN:
            self.diagnostics.value(name, str(getattr(self._predictor.counts, name)))
        trouble = self._show_condition()
        self.diagnostics.value("waiting inbox", str(self._inbox.qsize()))
        age, frame_age = self.diagnostics.age(GRIPPER_POSE), self.diagnostics.age(TRACKER_POINTS)
        overload_age = self.diagnostics.age("dropped messages")
        limit = max(self.config.max_gap, 0.2)
        if self._predictor.halted is not None:
            self.report(ERROR, str(self._predictor.halted))
        elif self.refusal:
            self.report(ERROR, self.refusal)
        elif overload_age is not None and overload_age < OVERLOAD_SHOWN:
            self.report(WARN, self._overload)
        elif age is None or age > limit:
            since = "never came" if age is None else f"stopped {age:.1f} s ago"
            self.report(
                ERROR if frame_age is not None and frame_age < limit else WARN, f"{GRIPPER_POSE} {since}: no prediction"
            )
        elif self._closed is None:
            self.report(ERROR, f"{GRIPPER_CLOSED} never came: no prediction")
        elif not self._predictor.running:
            self.report(WARN, f"waiting for a start: {self._predictor.waiting()}")
        else:
            self.report(*trouble)

    def _show_condition(self) -> tuple[bytes, str]:
        """Level and line of a run that goes on; an estimate may stand on the model alone, or have been lost."""
        if not isinstance(self._predictor, Follower):
            return OK, "predicting"
        now = self._predictor.condition()
        for name, text in now.shown().items():
            self.diagnostics.value(name, text)
        trouble = now.trouble()
        if not trouble:
            return OK, "following the tracks"
        return ERROR if now.level == "stopped" else WARN, trouble

    def _subscribe_when_heard(self) -> None:
        if self._inputs or self._prediction_out.get_subscription_count() < self.config.wait_for:
            return
        queued = self.config.overload == "queue"
        poses, points = (qos.points_complete(),) * 2 if queued else (qos.poses_live(), qos.points_live())
        self._inputs = [
            self.create_subscription(UInt8MultiArray, GRIPPER_CLOSED, self._on_closed, poses),
            self.create_subscription(PoseArray, GRIPPER_POSE, self._on_pose, poses),
            self.create_subscription(PointCloud2, TRACKER_POINTS, self._on_points, points),
        ]
        self._starter.cancel()

    def _on_closed(self, message: UInt8MultiArray) -> None:
        self.take(GRIPPER_CLOSED, lambda: self._set_closed(convert.message_to_closed(message)))

    def _on_closed_before(self, message: UInt8MultiArray) -> None:
        """What was said once and for all before this node began; what is said now comes to `_on_closed`."""
        if self._closed is None:
            self._on_closed(message)

    def _on_pose(self, message: PoseArray) -> None:
        self.take(GRIPPER_POSE, lambda: self._post(self._add_pose, convert.message_to_pose(message), self._closed))

    def _on_points(self, message: PointCloud2) -> None:
        self.take(TRACKER_POINTS, lambda: self._post(self._add_points, convert.cloud_to_points(message)))

    def _set_closed(self, closed: NDArray[np.bool_]) -> None:
        self._closed = closed

    def _post(self, action: Callable[..., None], *values: object) -> None:
        self._inbox.put((self.seconds(), lambda: action(*values)))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._post(self._reset)
        response.success, response.message = True, "starting anew from the next tracker frames"
        return response

    # Below: the worker thread. It alone touches the Predictor's state.

    def _work(self) -> None:
        while not self._stopping and (item := self._inbox.get()) is not None:
            arrived, action = item
            self._waited = self.seconds() - arrived
            try:
                with torch.no_grad():
                    action()
            except TwinError:
                raise
            except DivergenceError as error:
                self.diagnostics.count("divergences")
                self.report(ERROR, str(error))
            except PredError as error:
                self.refuse(error)

    def _reset(self) -> None:
        self._predictor.reset()
        self.diagnostics.count("resets")

    def _add_points(self, frame: PointFrame) -> None:
        self._predictor.add_points(frame)
        self._advance()

    def _add_pose(self, pose: PoseFrame, closed: NDArray[np.bool_] | None) -> None:
        if closed is None:
            self.diagnostics.count("poses before the first gripper/closed")
            return
        late = self._waited > self.config.max_backlog and self._inbox.qsize() > KEPT
        if self.config.overload == "newest" and late:
            self._drop_to_newest()
        self._predictor.add_pose(pose, closed)
        self._advance()

    def _drop_to_newest(self) -> None:
        dropped = 0
        while self._inbox.qsize() > KEPT:
            if self._inbox.get_nowait() is None:
                self._stopping = True
                return
            dropped += 1
        self._predictor.reset()
        total = self.diagnostics.count("dropped messages", dropped)
        self._overload = f"too slow: {dropped} messages dropped ({total} so far), starting anew from the newest data"
        self.diagnostics.seen("dropped messages")
        self.report(WARN, self._overload)

    def _advance(self) -> None:
        for prediction in self._predictor.advance():
            self._state_out.publish(convert.state_to_cloud(prediction.stamp, self._ids, prediction.state))
            ahead = convert.state_to_cloud(prediction.ahead_stamp, self._ids, prediction.ahead)
            self._prediction_out.publish(ahead)
            self.diagnostics.count("predictions")


def main() -> NoReturn:
    """Entry point of `ros2 run pred_ros predictor`."""
    shell.main(PredictorNode)


if __name__ == "__main__":
    main()

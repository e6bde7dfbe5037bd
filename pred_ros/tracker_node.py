"""The tracker: pictures of up to eight RGB-D cameras in, persistent particles out.

In: camN/color/image_raw, camN/depth/image_raw, camN/color/camera_info, camN/pose, gripper/pose, gripper/closed, and
with `prior` state/points. Out: tracker/points with the stamp of the newest picture. `~/reset` (Trigger) searches anew.
"""

from __future__ import annotations

import functools
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import numpy as np
from geometry_msgs.msg import PoseArray, PoseStamped
from numpy.typing import NDArray
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import Trigger

from pred_core.bag import images
from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, STATE_POINTS, TRACKER_POINTS
from pred_core.config import setting
from pred_core.errors import ConfigError, InputError, PredError
from pred_core.track.estimate import Estimate, Prior
from pred_core.track.settings import TrackerSettings, make_tracker, parse_cameras, parse_fixtures
from pred_core.track.tracker import Tracker
from pred_ros import convert, qos, shell
from pred_ros.camera_pairs import NO_PICTURES, CameraPairs
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.shell import REFUSAL_SHOWN, Shell

SILENT = 1.0  # [s] without a complete picture before a camera counts as dead
HEARD = 2.0  # [s] for which a gripper that is there is waited for: whether it is closed is said once a second
OLD = 2.0  # [s] since the newest particles before they are not of now, whatever the pictures do
WAITING = "waiting"
NEWEST = "newest particles"
SURE = 0.5  # confidence that only a particle in view exceeds
NEWS = 1000  # gripper poses and priors that wait for a busy worker, the newest: more than 2 s, which is all it keeps
GAP, GAP_TIMES = 0.25, 2.5  # [s], usual times between pictures: a longer silence of all cameras is said afterwards


@dataclass(frozen=True)
class TrackerNodeConfig(TrackerSettings):
    """Parameters of the tracker: its settings (pred_core/track/settings.py), and what only the node has."""

    prior: bool = setting(False, doc="use state/points of the predictor as motion prior")
    prior_sigma: float = setting(0.01, unit="m", low=1e-3, high=0.5, doc="standard deviation of the prior")
    autostart: bool = setting(True, doc="configure and activate without a lifecycle manager")


class TrackerNode(Shell):
    """Callbacks only store messages; one worker thread owns the `Tracker`."""

    NAME: ClassVar[str] = "tracker"
    CONFIG: ClassVar[type] = TrackerNodeConfig
    PICTURES: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__()
        self._worker: Future[None] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="tracking")
        self._inputs: list[Subscription] = []
        self._grippers: list[Subscription] = []
        self._gripped = False  # the tracker has a gripper's pose and knows whether it is closed
        self._first: float | None = None  # [s] of the first pictures
        self._lock = threading.Lock()  # guards what callbacks hand to the worker
        self._news: deque[Callable[[Tracker], None]] = deque(maxlen=NEWS)
        self._anew = False  # somebody has asked for a search
        self._closed: NDArray[np.bool_] = np.zeros(0, bool)
        self._status = "searching"
        self._surest = 0.0  # confidence of the surest of the newest particles
        self._odd: tuple[str, float] | None = None
        self._slipped = False
        self._gap = ""
        self._spacings: deque[float] = deque(maxlen=9)  # [s] between the newest pictures
        self._stopping = False

    def setup(self) -> None:
        """Check the parameters, build the tracker."""
        config: TrackerNodeConfig = self.config
        self._names = parse_cameras(config.cameras)
        self._tracker = make_tracker(config)
        self._out = self.create_publisher(PointCloud2, TRACKER_POINTS, qos.points_complete())
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.report(WARN, f"waiting for pictures of {', '.join(self._names)}")

    def start(self) -> None:
        """Subscribe and start the worker."""
        self._pairs = CameraPairs(self._names, self.seconds)
        self._stopping, self._published, self._gripped, self._first = False, -1, False, None
        self._status = "searching"
        for name in self._names:
            for kind, topic in (("color", images.COLOR), ("depth", images.DEPTH)):
                callback = functools.partial(self._on_image, name, kind)
                self._listen(Image, f"{name}/{topic}", callback, qos_profile_sensor_data)
            for message_type, topic, profile, add in (
                (CameraInfo, images.INFO, qos_profile_sensor_data, self._pairs.add_info),
                (PoseStamped, images.POSE, qos.latched(), self._pairs.add_pose),
            ):
                callback = functools.partial(self.take, f"{name}/{topic}", functools.partial(add, name))
                self._listen(message_type, f"{name}/{topic}", callback, profile)
        closed = self._listen(UInt8MultiArray, GRIPPER_CLOSED, self._on_closed, qos.points_live())
        self._latched: Subscription | None = None
        self._grippers = [closed, self._listen(PoseArray, GRIPPER_POSE, self._on_pose, qos.poses_live())]
        if self.config.prior:
            self._listen(PointCloud2, STATE_POINTS, self._on_state, qos.points_live())
        self._watch = self.create_timer(0.05, lambda: self.check_worker(self._worker))
        self._worker = self._pool.submit(self._work)  # last: what fails before leaves no thread behind

    def stop(self) -> None:
        """End the worker."""
        if self._worker is None:
            return
        self._worker = None
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._inputs, self._grippers = [], []
        self.destroy_timer(self._watch)
        self._stopping = True
        self._pairs.close()
        self._pool.shutdown(wait=True)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="tracking")

    def changed(self, config: TrackerNodeConfig) -> None:
        """Parameters are fixed while the node is active."""
        parse_cameras(config.cameras)
        parse_fixtures(config.fixtures)
        if self._worker is not None:
            raise ConfigError(
                "parameters of the tracker cannot change while it is active", next_step="Deactivate the node first"
            )

    def heartbeat(self) -> None:
        """Judge ages: dead cameras, refused messages, whether the object is in view."""
        if self._worker is None:
            return
        if self._latched is None and not len(self._closed) and qos.is_latched(self, GRIPPER_CLOSED):
            self._latched = self._listen(UInt8MultiArray, GRIPPER_CLOSED, self._on_closed_before, qos.latched())
        self.diagnostics.value("pictures dropped, newer came", str(self._pairs.dropped))
        self.diagnostics.value("pictures that came too late", str(self._tracker.stale))
        self.diagnostics.value("pictures without their partner", str(self._pairs.unpaired))
        self.report(*self._verdict())

    def _verdict(self) -> tuple[bytes, str]:
        """What is wrong, the worst first; a cause before what follows from it."""
        if self.refusal:
            return ERROR, self.refusal
        silent = {name: self._pairs.why(name) for name in self._pairs.silent(SILENT)}
        if len(silent) == len(self._names):
            return ERROR, _nothing(silent)
        if self._status == WAITING:
            return WARN, "waiting for the gripper, which says which end of a line is the first"
        if self._status != "tracking":
            return WARN, f"{self._status}: the object is not in view, or is not a {self.config.kind}"
        age = self.diagnostics.age(NEWEST)
        if age is None or not 0.0 <= age <= OLD:
            return WARN, f"the newest particles are {age or 0.0:.1f} s old though pictures come: too slow for them?"
        gap_age = self.diagnostics.age("last gap")
        if gap_age is not None and gap_age < REFUSAL_SHOWN:
            return WARN, self._gap
        if self._slipped:
            return WARN, "tracking; the object has slipped out of the gripper"
        if self._odd is not None:
            camera, off = self._odd
            return WARN, f"{camera} sees the object {1e3 * off:.0f} mm off: has it been moved? Calibrate it anew"
        if silent:
            return WARN, f"tracking without {_grouped(silent)}"
        if self._surest <= SURE:  # after what may be its cause
            return WARN, f"tracking, but no particle's confidence is above {SURE:g}: is the object in view?"
        return OK, "tracking"

    def _listen(self, kind: Any, topic: str, callback: Callable[[Any], None], profile: Any) -> Subscription:
        self._inputs.append(self.create_subscription(kind, topic, callback, profile))
        return self._inputs[-1]

    def _on_image(self, name: str, kind: str, message: Image) -> None:
        self.diagnostics.seen(f"{name} {kind}")
        self._pairs.add_image(name, kind, message)

    def _on_closed(self, message: UInt8MultiArray) -> None:
        self.take(GRIPPER_CLOSED, self._set_closed, message)

    def _on_closed_before(self, message: UInt8MultiArray) -> None:
        """What was said once and for all before this node began; what is said now comes to `_on_closed`."""
        if not len(self._closed):
            self._on_closed(message)

    def _set_closed(self, message: UInt8MultiArray) -> None:
        closed = convert.message_to_closed(message)
        if not len(closed):
            raise InputError(f"{GRIPPER_CLOSED} is empty", allowed="one flag a gripper", next_step="Check who sends it")
        self._closed = closed

    def _on_pose(self, message: PoseArray) -> None:
        self.take(GRIPPER_POSE, self._add_pose, message)

    def _add_pose(self, message: PoseArray) -> None:
        pose = convert.message_to_pose(message)
        closed = self._closed
        self._tell(lambda tracker: self._add_grip(tracker, pose, closed))

    def _on_state(self, message: PointCloud2) -> None:
        self.take(STATE_POINTS, self._add_state, message)

    def _add_state(self, message: PointCloud2) -> None:
        stamp, ids, state = convert.cloud_to_state(message, STATE_POINTS)
        position, velocity = (x.numpy().astype(np.float64) for x in (state.position, state.velocity))
        prior = Prior(stamp, ids, position, velocity, self.config.prior_sigma)
        self._tell(lambda tracker: tracker.set_prior(prior))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._anew = True
        response.success, response.message = True, "searching in the next pictures"
        return response

    def _tell(self, action: Callable[[Tracker], None]) -> None:
        with self._lock:
            self._news.append(action)

    # Below: the worker thread. It alone touches the Tracker.

    def _work(self) -> None:
        while not self._stopping:
            pairs = self._pairs.take(self.config.patience)
            self._hear()
            if not pairs:
                continue
            waits = self._waits()
            for name, pair in pairs.items():
                try:
                    picture = self._pairs.picture(name, pair)
                    if not waits:
                        self._tracker.add_frame(name, picture)
                except PredError as error:
                    self.refuse(error)
            if waits:
                self._status = WAITING
                continue
            estimate = self._tracker.step()
            if estimate is not None:
                self._publish(estimate)
            self._status = "searching" if estimate is None else estimate.status

    def _hear(self) -> None:
        """Do what came between the pictures; what cannot be used is refused, and the rest goes on."""
        if self._anew:
            self._anew = False
            self._tracker.reset()
            self._status = "searching"
        with self._lock:
            news = list(self._news)
            self._news.clear()
        for action in news:
            try:
                action(self._tracker)
            except PredError as error:
                self.refuse(error)

    def _add_grip(self, tracker: Tracker, pose: PoseFrame, closed: NDArray[np.bool_]) -> None:
        tracker.add_grip(pose.stamp, pose.position, pose.rotation, closed)
        if not self._gripped and self._published >= 0 and closed.any():  # begun without it: its ends are by chance
            tracker.reset()
            self.diagnostics.count("searched anew: the gripper was heard late")
        self._gripped = self._gripped or len(closed) > 0

    def _waits(self) -> bool:
        """A gripper that is there but was not heard yet is waited for: a line that begins without it keeps its ends."""
        self._first = self._first or self.seconds()  # 0: a simulated clock that has not been heard yet
        if self._gripped or self.seconds() - self._first > HEARD:
            return False
        return any(s.get_publisher_count() for s in self._grippers)

    def _publish(self, estimate: Estimate) -> None:
        t = estimate.tracks
        if int(t.stamp) == self._published:  # a late camera's picture of the same instant
            self.diagnostics.count("estimates of an instant that was published")
            return
        self._note_gap((int(t.stamp) - self._published) * 1e-9)
        self._published = int(t.stamp)
        frame = PointFrame(int(t.stamp), t.position, t.id, t.confidence, None)
        self._out.publish(convert.points_to_cloud(frame))
        self.diagnostics.seen(NEWEST)
        self._surest = float(t.confidence.max(initial=0.0))
        self._odd, self._slipped = estimate.odd_camera(), estimate.slipped
        self.diagnostics.count("estimates")
        self.diagnostics.value("residual [mm]", f"{1e3 * estimate.residual:.2f}")
        self.diagnostics.value("particles in view", f"{int(t.visible.sum())} of {len(t.id)}")

    def _note_gap(self, spacing: float) -> None:
        """Say it if the cameras were silent; `spacing` [s] from the instant before to the newest one."""
        usual = float(np.median(self._spacings)) if self._spacings else np.inf
        if self._published >= 0 and spacing > 0.0:
            if spacing > max(GAP, GAP_TIMES * usual):
                self._gap = f"no pictures of any camera for {spacing:.2f} s; tracking again"
                self.diagnostics.seen("last gap")
                self.diagnostics.count("gaps")
                self.report(WARN, self._gap)
            self._spacings.append(spacing)


def _nothing(silent: dict[str, str]) -> str:
    """The line where no camera, of camera -> why, gives a complete picture."""
    if set(silent.values()) == {NO_PICTURES}:
        return f"no pictures of {', '.join(silent)}: nothing is tracked"
    return f"nothing is tracked; {_grouped(silent)}"


def _grouped(silent: dict[str, str]) -> str:
    """'cam0, cam2: no pictures; cam1: ...' of camera -> why."""
    names: dict[str, list[str]] = {}
    for name, why in silent.items():
        names.setdefault(why, []).append(name)
    return "; ".join(f"{', '.join(group)}: {why}" for why, group in names.items())


def main() -> NoReturn:
    """Entry point of `ros2 run pred_ros tracker`."""
    shell.main(TrackerNode)


if __name__ == "__main__":
    main()

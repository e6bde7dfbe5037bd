"""The tracker node fed over real topics: what it publishes, and how it answers bad input."""

from __future__ import annotations

import dataclasses
import functools
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("mujoco", reason="MuJoCo is not installed")

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from ros_bench import Bench, bench_of, own_domain
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import Trigger
from track_scenes import LENGTH, STEP, TURN, HangingRope

from pred_core.bag import images
from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS
from pred_core.errors import ConfigError
from pred_core.track import line_tracker
from pred_core.track.settings import parse_cameras, parse_fixtures
from pred_core.types import CameraFrame
from pred_ros import convert, qos, tracker_node
from pred_ros.tracker_node import TrackerNode

ERROR, WARN, OK = DiagnosticStatus.ERROR, DiagnosticStatus.WARN, DiagnosticStatus.OK
HEARD_LATE = "searched anew: the gripper was heard late"
START = 5_000_000_000  # [ns]
NAMES = ("cam0", "cam1")
CLOSED = np.array([True])
PARAMETERS = {"cameras": "cam0 cam1", "particles": "26", "patience": "0.2"}


class Rig:
    """Publishers that look like two camera drivers and an arm."""

    def __init__(self, bench: Bench, scene: HangingRope):
        self.bench, self.scene = bench, scene
        make = bench.world.create_publisher
        self.color = {n: make(Image, f"{n}/{images.COLOR}", qos_profile_sensor_data) for n in NAMES}
        self.depth = {n: make(Image, f"{n}/{images.DEPTH}", qos_profile_sensor_data) for n in NAMES}
        self.info = {n: make(CameraInfo, f"{n}/{images.INFO}", qos_profile_sensor_data) for n in NAMES}
        self.pose = {n: make(PoseStamped, f"{n}/{images.POSE}", qos.latched()) for n in NAMES}
        self.frames: list[PointFrame] = []
        bench.world.create_subscription(PointCloud2, TRACKER_POINTS, self._on_points, qos.points_complete())
        bench.until(lambda: all(p.get_subscription_count() for p in self.color.values()), "the node listens")

    def _on_points(self, message: PointCloud2) -> None:
        self.frames.append(convert.cloud_to_points(message))

    def calibrate(self, frame: CameraFrame, name: str, world: str = "world") -> None:
        """Publish calibration and pose."""
        height, width = frame.depth.shape
        k = frame.intrinsics.ravel().tolist()
        self.info[name].publish(CameraInfo(header=convert.header_at(START), height=height, width=width, k=k))
        w, x, y, z = images.rotation_of(frame.world_from_camera).tolist()
        px, py, pz = frame.world_from_camera[:3, 3].tolist()
        pose = Pose(position=Point(x=px, y=py, z=pz), orientation=Quaternion(w=w, x=x, y=y, z=z))
        self.pose[name].publish(PoseStamped(header=convert.header_at(START, world), pose=pose))

    def show(self, frame: CameraFrame, name: str, depth_frame: str = "", depth_off: int | None = 0) -> None:
        """Publish a picture; `depth_off` [ns]: of the depth's stamp from the colour's, None: no depth."""
        height, width = frame.depth.shape
        optical = images.optical_frame(name)
        color = Image(header=convert.header_at(frame.stamp, optical), height=height, width=width, encoding="rgb8")
        color.step, color.data = 3 * width, array("B", frame.rgb.tobytes())
        self.color[name].publish(color)
        if depth_off is not None:
            header = convert.header_at(frame.stamp + depth_off, depth_frame or optical)
            depth = Image(header=header, height=height, width=width, encoding="32FC1", step=4 * width)
            depth.data = array("B", frame.depth.tobytes())
            self.depth[name].publish(depth)

    def shown(self, frame: CameraFrame, name: str) -> bool:
        """Publish a picture; whether the node says that it waits for the gripper."""
        self.show(frame, name)
        return self.bench.says(WARN, "waiting for the gripper")

    def all(self, stamp: int, **changes: Any) -> None:
        """Gripper and both cameras at one stamp."""
        self.close()
        self.hold(stamp)
        for name, frame in self.scene.frames(stamp).items():
            self.calibrate(frame, name)
            self.show(dataclasses.replace(frame, **changes), name)

    def close(self) -> None:
        """Say that the gripper is closed."""
        self.bench.closed_out.publish(convert.closed_to_message(np.array([True])))

    def hold(self, stamp: int) -> None:
        """Say where the gripper is."""
        self.bench.pose_out.publish(convert.pose_to_message(PoseFrame(stamp, self.scene.gripper[None], TURN)))

    def until_held(self) -> None:
        """Before the first picture, the gripper must have been heard: it says which end is the first."""
        before = functools.partial(self.hold, START - STEP)
        for topic, say in ((GRIPPER_CLOSED, self.close), (GRIPPER_POSE, before)):
            self.bench.until(functools.partial(self._heard, f"messages on {topic}", say), topic)

    def _heard(self, counter: str, say: Callable[[], None]) -> bool:
        say()
        return self.bench.node.diagnostics.counter(counter) > 0

    def until_found(self) -> None:
        """Show pictures until particles come; the first ones may arrive before their calibration."""
        self.until_held()
        for k in range(40):
            count = len(self.frames)
            self.all(START + k * STEP)
            self.bench.until(functools.partial(self._answered, count, k), "an answer")
            if len(self.frames) >= 4:  # the first ones may miss an end, which later ones show
                return
        raise AssertionError(f"never found; node says {self.bench.node.diagnostics.message}")

    def show_until(self, condition: Callable[[], bool], names: Sequence[str], limit: float = 60.0) -> None:
        """Go on with pictures of some cameras; diagnostics come once a second and want fresh ones."""
        end = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < end, self.bench.node.diagnostics.message
            count, stamp = len(self.frames), self.frames[-1].stamp + STEP
            for name, frame in self.scene.frames(stamp).items():
                if name in names:
                    self.show(frame, name)
            self.bench.until(functools.partial(self._answered, count, 20), "particles")

    def _answered(self, count: int, sent: int) -> bool:
        """More than `count` clouds came, or one of the first pictures was refused."""
        refused = self.bench.node.diagnostics.counter("refused messages") > 0
        return len(self.frames) > count or (refused and sent < 20)


@pytest.fixture(scope="module")
def scene() -> Iterator[HangingRope]:
    made = HangingRope(cameras=2)
    yield made
    made.close()


@pytest.fixture
def rig(scene: HangingRope) -> Iterator[Rig]:
    scene.move(np.zeros(3))
    with bench_of(TrackerNode, PARAMETERS, feeds=False) as bench:
        yield Rig(bench, scene)


def test_particles_lie_on_the_rope_and_carry_the_capture_stamp(rig: Rig) -> None:
    rig.until_found()
    last = rig.frames[-1]
    assert (last.stamp - START) % STEP == 0
    assert last.id.tolist() == list(range(26))
    error = np.linalg.norm(last.position - rig.scene.truth(26), axis=-1)
    # Two cameras of 320 x 240: the end of the rope is known to a pixel of 3.3 mm, a slide along it comes on top.
    assert error.mean() < 0.007 and error.max() < 0.012
    assert last.visible.all()
    length = np.linalg.norm(np.diff(last.position, axis=0), axis=-1).sum()
    assert length == pytest.approx(LENGTH, abs=0.010)
    rig.show_until(lambda: rig.bench.says(OK, "tracking"), NAMES)


def test_a_gripper_that_is_there_is_waited_for(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line that begins without it has its ends by chance and keeps them: the held one would not be the first."""
    monkeypatch.setattr(tracker_node, "HEARD", 1e9)
    for name, frame in rig.scene.frames(START - 2 * STEP).items():
        rig.calibrate(frame, name)
        rig.bench.until(functools.partial(rig.shown, frame, name), "a picture that waits")
    assert not rig.frames
    rig.until_found()
    away = np.linalg.norm(rig.frames[0].position - rig.scene.gripper, axis=-1)
    assert away[0] < away[-1]


def test_a_gripper_that_said_once_that_it_is_closed_is_heard() -> None:
    """Latched before the node began, and never again."""
    with own_domain():
        rclpy.init()
        try:
            driver = rclpy.create_node("driver")
            driver.create_publisher(UInt8MultiArray, GRIPPER_CLOSED, qos.latched()).publish(
                convert.closed_to_message(CLOSED)
            )
            node: Any = TrackerNode()
            node.trigger_configure()
            node.trigger_activate()
            executor = SingleThreadedExecutor()
            for each in (node, driver):
                executor.add_node(each)
            end = time.monotonic() + 20.0
            while not len(node._closed):
                assert time.monotonic() < end, "never heard"
                executor.spin_once(timeout_sec=0.05)
            executor.shutdown()
            node.stop()
            node.destroy_node()
            driver.destroy_node()
        finally:
            rclpy.try_shutdown()


def test_a_gripper_that_is_heard_late_turns_the_line(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Begun without it, the far end can be the first; then it speaks, and the held end is the first from then on."""
    first_end = line_tracker.from_first_end

    def far_end(path: Any, grips: Any, config: Any) -> Any:
        hanging = path if path[0, 2] < path[-1, 2] else path[::-1]
        return first_end(path, grips, config) if len(grips) else hanging

    monkeypatch.setattr(line_tracker, "from_first_end", far_end)
    monkeypatch.setattr(tracker_node, "HEARD", 0.0)
    monkeypatch.setattr(rig, "close", lambda: None)
    monkeypatch.setattr(rig, "hold", lambda stamp: None)
    monkeypatch.setattr(rig, "until_held", lambda: None)
    rig.until_found()
    away = np.linalg.norm(rig.frames[-1].position - rig.scene.gripper, axis=-1)
    assert away[0] > away[-1] and rig.bench.node.diagnostics.counter(HEARD_LATE) == 0
    monkeypatch.undo()
    before = len(rig.frames)
    rig.all(rig.frames[-1].stamp + STEP)
    rig.bench.until(lambda: rig.bench.node.diagnostics.counter(HEARD_LATE) == 1, "the gripper's pose")
    rig.show_until(lambda: len(rig.frames) > before + 3, NAMES)
    away = np.linalg.norm(rig.frames[-1].position - rig.scene.gripper, axis=-1)
    assert away[0] < away[-1]


def test_one_dead_camera_is_named_and_the_other_goes_on(rig: Rig) -> None:
    rig.until_found()
    rig.show_until(lambda: rig.bench.says(WARN, "tracking without cam1"), ("cam0",))


def test_what_comes_without_pictures_is_heard_and_does_not_pile_up(rig: Rig) -> None:
    node, sent = rig.bench.node, 0

    def heard() -> bool:
        nonlocal sent
        if node.diagnostics.counter(f"messages on {GRIPPER_POSE}") > 10:
            return not node._news
        sent += 1
        rig.hold(START + sent * STEP)
        return False

    rig.close()
    rig.bench.until(heard, "poses that reached the tracker, without a picture", limit=10.0)


def test_one_refused_message_takes_nothing_else_with_it(rig: Rig) -> None:
    """A pose the tracker refuses, then a good one and a search: both are done. What waits is bounded."""
    rig.until_found()
    node: Any = rig.bench.node
    with node._lock:  # the worker finds all of it at once
        bad = functools.partial(node._add_grip, pose=PoseFrame(START, np.full((1, 3), np.nan), TURN), closed=CLOSED)
        good, next_one = (
            functools.partial(node._add_grip, pose=PoseFrame(at, rig.scene.gripper[None], TURN), closed=CLOSED)
            for at in (9 * START, 9 * START + 1)
        )
        node._news.extend([bad, good, next_one])
        answer = node._on_reset(Trigger.Request(), Trigger.Response())
    rig.bench.until(lambda: rig.bench.says(ERROR, "gripper pose is not finite"), "the refusal")
    rig.bench.until(lambda: node._tracker._path.at(9 * START) is not None, "the pose after it")
    assert answer.success and node._tracker.searching
    with node._lock:  # a worker that is busy for long
        node._news.extend([good] * (tracker_node.NEWS + 1))
        assert len(node._news) == tracker_node.NEWS


@pytest.mark.parametrize(
    ("depth_off", "said"), [(None, "colour without depth"), (5_000_000, "stamps of colour and depth differ by 5 ms")]
)
def test_pictures_without_a_partner_are_not_tracking(rig: Rig, depth_off: int | None, said: str) -> None:
    rig.until_found()
    count, stamp = len(rig.frames), rig.frames[-1].stamp
    frames, pause = rig.scene.frames(stamp), 0.05  # [s]

    def shown() -> bool:
        nonlocal stamp
        stamp += STEP
        for name, frame in frames.items():
            rig.show(dataclasses.replace(frame, stamp=stamp), name, depth_off=depth_off)
        end = time.monotonic() + pause
        while time.monotonic() < end:
            rig.bench.executor.spin_once(timeout_sec=0.01)
        return rig.bench.says(ERROR, "nothing is tracked", "cam0, cam1", said)

    rig.bench.until(shown, "an error that says why", limit=10.0)
    assert rig.bench.node.diagnostics.level == ERROR and len(rig.frames) <= count + 2, "a last picture may be under way"
    rig.show_until(lambda: rig.bench.node.diagnostics.level == OK, NAMES)


def test_particles_that_are_not_of_now_are_not_tracking(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever keeps the worker from publishing: the line is of what was published, not of what was meant to be."""
    rig.until_found()
    monkeypatch.setattr(tracker_node, "OLD", -1.0)
    rig.bench.node._heartbeat()
    assert rig.bench.node.diagnostics.level == WARN
    assert "the newest particles are 0.0 s old" in rig.bench.node.diagnostics.message


def test_camera_pose_in_another_frame_is_refused(rig: Rig) -> None:
    rig.calibrate(rig.scene.frames(START)["cam0"], "cam0", world="map")
    rig.bench.until(lambda: rig.bench.says(ERROR, "cam0/pose", "map", "world"), "an error that names the frame")


def test_missing_calibration_is_named(rig: Rig) -> None:
    rig.show(rig.scene.frames(START)["cam1"], "cam1")
    rig.bench.until(lambda: rig.bench.says(ERROR, "cam1", "calibration missing", "camera_info"), "an error")
    assert rig.bench.node.exit_code is None


def test_depth_that_is_all_nan_is_named_and_the_run_goes_on(rig: Rig) -> None:
    rig.until_found()
    stamp = rig.frames[-1].stamp + STEP
    rig.all(stamp, depth=np.full((240, 320), np.nan, np.float32))
    rig.bench.until(lambda: rig.bench.says(ERROR, "no pixel has a depth"), "an error that names the camera")
    count = len(rig.frames)
    rig.all(stamp + STEP)
    rig.bench.until(lambda: len(rig.frames) > count, "particles again")


def test_depth_in_millimetres_said_to_be_metres_is_named(rig: Rig) -> None:
    rig.until_found()
    frame = rig.scene.frames(rig.frames[-1].stamp + STEP)["cam0"]
    rig.show(dataclasses.replace(frame, depth=1000.0 * frame.depth), "cam0")
    rig.bench.until(lambda: rig.bench.says(ERROR, "cam0", "are these millimetres?"), "an error that names the unit")


def test_particles_that_nobody_sees_are_not_reported_as_fine(rig: Rig) -> None:
    rig.until_found()
    rig.show_until(lambda: rig.bench.says(OK, "tracking"), NAMES)
    rig.scene.move(np.array([3.0, 0.0, 0.0]))  # out of every picture
    rig.show_until(lambda: rig.bench.says(WARN, "no particle's confidence is above 0.5"), NAMES)
    assert rig.frames[-1].confidence.max() <= 0.5


def test_depth_of_another_frame_is_refused(rig: Rig) -> None:
    frame = rig.scene.frames(START)["cam0"]
    for _ in range(20):
        rig.calibrate(frame, "cam0")
        rig.show(frame, "cam0", depth_frame="cam0_depth_optical_frame")
        for _ in range(20):
            rig.bench.executor.spin_once(timeout_sec=0.01)
        if rig.bench.says(ERROR, "not registered"):
            break
    assert rig.bench.says(ERROR, "cam0", "not registered", "cam0_depth_optical_frame")


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (["cameras:=''"], "parameter 'cameras'; got ''; allowed: 1 to 8"),
        (["kind:=sheet", "points:=tapnext", "points_folder:=nowhere"], "TAPNext: no weights on disk; got nowhere"),
    ],
)
def test_what_cannot_be_ends_the_node_with_one_line(
    parameters: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with own_domain():
        rclpy.init(args=["--ros-args", *(word for p in parameters for word in ("-p", p))])
        node = TrackerNode()
        try:
            node.trigger_configure()
            assert node.exit_code == 2
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
    assert capfd.readouterr().err.count(said) == 1


def test_lists_in_parameters() -> None:
    assert parse_cameras("cam0, cam3") == ["cam0", "cam3"]
    with pytest.raises(ConfigError, match="1 to 8"):
        parse_cameras(" ".join(f"cam{i}" for i in range(9)))
    for name in ("cam 0$", "/cam0$", "0cam", "cam0//x", ""):
        with pytest.raises(ConfigError, match="prefixes of topics"):
            parse_cameras(name)
    for text in ("nan 0 0 1 1 1", "0 0 0 -1 -1 -1", "0 0 0 1 1 inf"):
        with pytest.raises(ConfigError, match="half sizes above 0"):
            parse_fixtures(text)
    box = parse_fixtures("0.1 0 0.05 0.006 0.045 0.05;")[0]
    assert box.center == (0.1, 0.0, 0.05) and box.half_size == (0.006, 0.045, 0.05)
    with pytest.raises(ConfigError, match="six numbers"):
        parse_fixtures("0.1 0")

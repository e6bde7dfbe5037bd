"""Line objects: the fit on points with known answers, the tracker on rendered pictures of a straight rope."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from track_scenes import LENGTH, STEP, HangingRope

from pred_core.errors import ConfigError, InputError
from pred_core.track.band import ChainSystem
from pred_core.track.color_model import ColorModel
from pred_core.track.estimate import Estimate, Prior
from pred_core.track.grasp import GripperPath
from pred_core.track.line_config import LineConfig
from pred_core.track.line_fit import Cloud, LineFitConfig, fit_line
from pred_core.track.line_start import LineStartConfig, find_line, resample
from pred_core.track.line_tracker import LineTracker
from pred_core.track.tracker import Tracker, TrackerConfig
from pred_core.track.workspace import Workspace, inside_any
from pred_core.types import Array, Box, Capsule, Sphere

START = 1_000_000_000  # [ns]
CONFIG = TrackerConfig(
    workspace=Workspace((-0.5, -0.5, 0.0), (0.5, 0.5, 0.9)), line=LineConfig(particles=26, length=LENGTH)
)


@pytest.fixture(scope="module")
def scene() -> Iterator[HangingRope]:
    made = HangingRope(cameras=3)
    yield made
    made.close()


@pytest.fixture
def tracker(scene: HangingRope) -> Tracker:
    scene.move(np.zeros(3))
    return Tracker(CONFIG, ["cam0", "cam1", "cam2"])


def feed(
    tracker: Tracker, scene: HangingRope, stamp: int, names: tuple[str, ...] = ("cam0", "cam1", "cam2")
) -> Estimate:
    """One step with pictures of some cameras."""
    tracker.add_grip(**scene.grip(stamp))
    for name, frame in scene.frames(stamp).items():
        if name in names:
            tracker.add_frame(name, frame)
    estimate = tracker.step()
    assert estimate is not None
    return estimate


def arc(count: int, radius: float = 0.2) -> Array:
    """Half a circle in the plane z = 0.1."""
    angle = np.linspace(0.0, np.pi, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, 0.1)], axis=-1)


def test_a_line_is_not_begun_while_its_gripper_is_late(tracker: Tracker, scene: HangingRope) -> None:
    """Ends get their ids when a line is begun. A gripper heard 0.2 s ago is waited for, one of 1.1 s not."""
    scene.move(np.zeros(3))
    begin = 10_000_000_000
    for stamp, begins in ((begin, False), (begin + 900_000_000, True)):
        tracker.reset()
        tracker.add_grip(**scene.grip(begin - 200_000_000))
        for name, frame in scene.frames(stamp).items():
            tracker.add_frame(name, frame)
        assert (tracker.step() is not None) == begins and tracker.searching != begins


def test_chain_system_equals_its_dense_twin() -> None:
    rng = np.random.default_rng(0)
    nodes = np.cumsum(rng.normal(0.0, 1.0, (7, 3)), axis=0)
    target = rng.normal(0.0, 1.0, (7, 3))
    system = ChainSystem(7)
    system.add_bending(0.3)
    system.add_points(np.tile(2.0 * np.eye(3), (7, 1, 1)), target)
    second = np.zeros((5, 7))
    for j in range(5):
        second[j, j : j + 3] = 1.0, -2.0, 1.0
    dense = 0.3 * second.T @ second + 2.0 * np.eye(7)
    np.testing.assert_allclose(system.solve(), np.linalg.solve(dense, 2.0 * target), atol=1e-9)
    inverse = np.linalg.inv(dense)
    np.testing.assert_allclose(system.covariance(), inverse.diagonal()[:, None, None] * np.eye(3), atol=1e-9)
    system.add_spacing(nodes, 1.0, 5.0)  # a step along the edge only
    assert np.isfinite(system.solve()).all()


def test_fit_goes_back_to_the_middle_of_a_noisy_arc() -> None:
    rng = np.random.default_rng(1)
    truth, dense = arc(41), arc(4000)
    points = dense + rng.normal(0.0, 0.002, dense.shape)
    cloud = Cloud(points, np.tile([0.0, 0.0, -1.0], (4000, 1)), np.ones(4000), np.zeros(4000), np.zeros(4000))
    spacing = float(np.linalg.norm(np.diff(truth, axis=0), axis=-1).mean())
    fit = fit_line(truth + rng.normal(0.0, 0.008, truth.shape), spacing, cloud, 0.004, LineFitConfig(), iterations=12)
    # 100 points of 2 mm a node make 0.2 mm across the line; along it only the ends count, to about the radius.
    across = np.linalg.norm(fit.nodes[:, :2], axis=-1) - 0.2
    assert np.abs(across).mean() < 6e-4 and np.abs(fit.nodes[:, 2] - 0.1).mean() < 6e-4
    assert np.linalg.norm(fit.nodes - truth, axis=-1).mean() < 0.004
    assert fit.explained > 0.99
    lengths = np.linalg.norm(np.diff(fit.nodes, axis=0), axis=-1)
    np.testing.assert_allclose(lengths, spacing, rtol=0.02)


def test_points_from_the_past_are_moved_to_now() -> None:
    truth, dense = arc(41), arc(4000)
    speed = np.array([0.0, 0.0, 0.5])  # [m/s], seen 40 ms ago: 2 cm below
    cloud = Cloud(
        dense - 0.04 * speed, np.tile([0.0, 0.0, -1.0], (4000, 1)), np.ones(4000), np.zeros(4000), np.full(4000, 0.04)
    )
    spacing = float(np.linalg.norm(np.diff(truth, axis=0), axis=-1).mean())
    fit = fit_line(truth, spacing, cloud, 0.004, LineFitConfig(), velocity=np.tile(speed, (41, 1)))
    assert np.abs(fit.nodes[:, 2] - 0.1).max() < 1e-4


def test_a_line_is_told_from_the_block_it_touches_by_colour() -> None:
    rng = np.random.default_rng(2)
    line = arc(3000) + rng.normal(0.0, 0.001, (3000, 3))
    block = rng.uniform(-0.04, 0.04, (6000, 3)) + arc(2)[0]  # around one end of the line
    points = np.concatenate([line, block])
    color = np.concatenate([np.tile([230, 110, 30], (3000, 1)), np.tile([60, 62, 65], (6000, 1))]).astype(np.uint8)
    found = find_line(points, color, LineStartConfig())
    assert found is not None
    assert found.member[:3000].mean() > 0.9 and found.member[3000:].mean() < 0.01
    assert found.length == pytest.approx(np.pi * 0.2, rel=0.06)
    assert find_line(block, color[3000:], LineStartConfig()) is None, "a block is no line"


def test_a_hole_in_the_depth_is_bridged_along_the_line_only() -> None:
    rng = np.random.default_rng(3)
    line = arc(4000)
    angle = np.linspace(0.0, 180.0, 4000)
    whole = line[(angle < 60.0) | (angle > 82.0)]  # a hole of 77 mm
    whole = whole + rng.normal(0.0, 0.001, whole.shape)
    beside = arc(2)[0] + [0.06, 0.0, 0.0] + rng.normal(0.0, 0.005, (60, 3))  # 60 mm off an end, across it
    points = np.concatenate([whole, beside])
    color = np.tile(np.array([230, 110, 30], np.uint8), (len(points), 1))
    found = find_line(points, color, LineStartConfig())
    assert found is not None and found.length == pytest.approx(np.pi * 0.2, rel=0.06)
    assert not found.member[len(whole) :].any()
    other = color.copy()
    other[: int((angle < 60.0).sum())] = [60, 62, 65]
    apart = find_line(points, other, LineStartConfig())
    assert apart is not None and apart.length < 0.6 * np.pi * 0.2, "what has another colour is another thing"


@pytest.mark.parametrize("first", [("cam0", "cam1"), ("cam0",), ("cam1",)])
def test_a_line_of_unknown_length_is_found_whole_by_two_small_cameras(first: tuple[str, ...]) -> None:
    small = HangingRope(cameras=2)
    try:
        for seed in range(5):
            small.generator = np.random.default_rng(seed)  # other holes in the depth
            line = LineConfig(particles=26)
            tracker = Tracker(dataclasses.replace(CONFIG, line=line), ["cam0", "cam1"])
            tracker.add_grip(**small.grip(START))
            for name in first:
                tracker.add_frame(name, small.frames(START)[name])
            tracker.step()  # one camera alone may find nothing
            for k in range(1, 4):
                estimate = feed(tracker, small, START + k * STEP, ("cam0", "cam1"))
            error = np.linalg.norm(estimate.tracks.position - small.truth(26), axis=-1)
            # The end of the rope is known to a pixel of 3.3 mm, a slide along it comes on top.
            assert error.mean() < 0.005 and error.max() < 0.012, f"noise {seed}"
            length = np.linalg.norm(np.diff(estimate.tracks.position, axis=0), axis=-1).sum()
            assert length == pytest.approx(LENGTH, abs=0.010), f"noise {seed}"
    finally:
        small.close()


def test_resample_keeps_ends_and_spacing() -> None:
    even = resample(arc(400), 11)
    np.testing.assert_allclose(even[[0, -1]], arc(400)[[0, -1]], atol=1e-12)
    step = np.linalg.norm(np.diff(even, axis=0), axis=-1)
    np.testing.assert_allclose(step, step[0], rtol=1e-3)


def test_shapes_of_the_workspace() -> None:
    point = np.array([[0.0, 0.0, 0.03]])
    assert inside_any(point, [Sphere((0.0, 0.0, 0.0), 0.031)], 0.0)[0]
    assert not inside_any(point, [Sphere((0.0, 0.0, 0.0), 0.029)], 0.0)[0]
    assert inside_any(point, [Capsule((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.02)], 0.011)[0]
    turned = Box((0.0, 0.0, 0.0), (0.05, 0.01, 0.01), (np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0))  # long side along z
    assert inside_any(point, [turned], 0.0)[0] and not inside_any(point, [Box((0, 0, 0), (0.05, 0.01, 0.01))], 0.0)[0]


def test_colour_that_does_not_tell_apart_is_not_used() -> None:
    rng = np.random.default_rng(3)
    grey = rng.integers(90, 130, (5000, 3)).astype(np.uint8)
    orange = np.clip(rng.normal((220, 100, 30), 10, (5000, 3)), 0, 255).astype(np.uint8)
    assert ColorModel(orange, grey).tells_apart
    assert not ColorModel(grey[:2500], grey[2500:]).tells_apart


def test_gripper_between_two_poses() -> None:
    path = GripperPath()
    quarter = np.array([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])
    path.add(0, np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    path.add(100, np.array([[0.1, 0.0, 0.0]]), quarter)
    found = path.at(50)
    assert found is not None
    np.testing.assert_allclose(found[0], [[0.05, 0.0, 0.0]])
    np.testing.assert_allclose(found[1][0][:2, 0], [np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)  # half of 90 degrees
    assert path.at(-1) is None and path.at(200_000_000) is None
    with pytest.raises(InputError, match="not finite"):
        path.add(200, np.full((1, 3), np.nan), quarter)


def test_a_line_whose_held_side_is_hidden_is_waited_for_but_not_for_ever() -> None:
    """Begun from what is seen of it, its free end could be the nearer one to the gripper, and be the first for good."""
    line, turn = LineTracker(CONFIG.line), np.eye(3)[None]
    path = np.linspace([0.0, 0.0, 0.3], [0.0, 0.0, 0.0], 30)
    closed, away, at = np.array([True]), (np.array([[0.0, 0.2, 0.0]]), turn), (np.array([[0.0, 0.05, 0.15]]), turn)
    hidden = [line._is_half_seen(path, START + k * 250_000_000, away, closed) for k in range(6)]
    assert hidden == [True] * 4 + [False] * 2
    fresh = LineTracker(CONFIG.line)
    assert not fresh._is_half_seen(path, START, at, closed), "held in the middle"
    assert not fresh._is_half_seen(path, START, away, ~closed) and not fresh._is_half_seen(path, START, None, closed)


def test_one_pose_out_of_line_is_named_and_the_path_goes_on() -> None:
    path, still = GripperPath(), np.array([[1.0, 0.0, 0.0, 0.0]])
    for k in range(10):
        path.add(START + k * 10_000_000, np.full((1, 3), 0.01 * k), still)
    path.add(START - 20 * 10**9, np.ones((1, 3)), still)
    with pytest.raises(InputError, match="gripper/pose: one stamp is out of line; got -20.090 s"):
        path.add(START + 100_000_000, np.full((1, 3), 0.1), still)
    found = path.at(START + 95_000_000)
    assert found is not None and found[0][0, 0] == pytest.approx(0.095)
    for k in range(2):  # a recording played again
        path.add(START + k * 10_000_000, np.zeros((1, 3)), still)
    assert path.at(START + 95_000_000) is None or path.at(START + 95_000_000)[0][0, 0] == 0.0


def test_flags_of_other_grippers_are_refused(tracker: Tracker, scene: HangingRope) -> None:
    feed(tracker, scene, START)
    for flags in ([True, True], [True, True, False]):
        with pytest.raises(InputError, match=f"gripper/closed does not match gripper/pose; got {len(flags)} flags"):
            tracker.add_grip(**{**scene.grip(START + STEP), "closed": np.array(flags)})
    assert feed(tracker, scene, START + STEP).status == "tracking"


def test_poses_are_awaited_only_near_their_time() -> None:
    """A gripper whose clock is far ahead or behind keeps nobody waiting."""
    path, still = GripperPath(), np.array([[1.0, 0.0, 0.0, 0.0]])
    path.add(10_000_000_000, np.zeros((1, 3)), still)
    assert [path.expected(s * 10**9, 1.0) for s in (1, 9, 10, 11, 1000)] == [False, False, False, False, False]
    assert path.expected(9_500_000_000, 1.0) and path.expected(10_500_000_000, 1.0)


def test_rope_is_found_and_followed(tracker: Tracker, scene: HangingRope) -> None:
    for k in range(8):
        scene.move(np.array([0.012, 0.006, 0.0]) * k)  # 0.2 m/s at 15 Hz
        estimate = feed(tracker, scene, START + k * STEP)
    assert int(estimate.tracks.stamp) == START + 7 * STEP
    error = np.linalg.norm(estimate.tracks.position - scene.truth(26), axis=-1)
    assert error.mean() < 0.004  # a pixel is 3.3 mm
    assert estimate.tracks.visible.all() and estimate.status == "tracking"
    speed = estimate.velocity.mean(axis=0)
    np.testing.assert_allclose(speed[:2], np.array([0.012, 0.006]) / (STEP * 1e-9), atol=0.03)


def test_cameras_of_different_rate_and_delay(tracker: Tracker, scene: HangingRope) -> None:
    late = None
    for k in range(9):
        scene.move(np.array([0.008, 0.0, 0.0]) * k)
        if late is not None:  # cam2 is one picture behind
            tracker.add_frame("cam2", late)
        late = scene.frames(START + k * STEP)["cam2"]
        estimate = feed(tracker, scene, START + k * STEP, ("cam0", "cam1") if k % 2 == 0 else ("cam0",))
    assert estimate.cameras == ("cam0", "cam1", "cam2")
    assert np.linalg.norm(estimate.tracks.position - scene.truth(26), axis=-1).mean() < 0.005


def test_unseen_rope_moves_with_its_gripper_and_says_so(tracker: Tracker, scene: HangingRope) -> None:
    for k in range(4):
        feed(tracker, scene, START + k * STEP)
    blind = {n: dataclasses.replace(f, rgb=np.zeros_like(f.rgb), depth=np.full_like(f.depth, 0.2))
             for n, f in scene.frames(0).items()}  # fmt: skip
    for k in range(4, 8):
        scene.move(np.array([0.0, 0.0, 0.004]) * (k - 3))
        tracker.add_grip(**scene.grip(START + k * STEP))
        for name, frame in blind.items():
            tracker.add_frame(name, dataclasses.replace(frame, stamp=START + k * STEP))
        estimate = tracker.step()
    assert estimate is not None and not estimate.tracks.visible.any()
    assert estimate.tracks.confidence.max() <= 0.5
    # Length and grasp carry the first particles up by 16 mm with the gripper.
    assert np.linalg.norm(estimate.tracks.position[:3] - scene.truth(26)[:3], axis=-1).max() < 0.01


def test_prior_leads_where_nothing_is_seen(tracker: Tracker, scene: HangingRope) -> None:
    for k in range(3):
        estimate = feed(tracker, scene, START + k * STEP)
    shifted = estimate.tracks.position + np.array([0.0, 0.0, 0.01])
    stamp = START + 3 * STEP
    tracker.set_prior(Prior(stamp, estimate.tracks.id, shifted, np.zeros_like(shifted), 0.002))
    scene.move(np.array([0.0, 0.0, 0.01]))
    tracker.add_grip(**scene.grip(stamp))
    frame = scene.frames(stamp)["cam0"]
    tracker.add_frame(
        "cam0", dataclasses.replace(frame, rgb=np.zeros_like(frame.rgb), depth=np.full_like(frame.depth, 0.2))
    )
    tracker._views.clear()  # nothing of the last pictures counts any more
    led = tracker.step()
    assert led is not None
    assert np.abs(led.tracks.position - shifted).max() < 0.002


def test_slipped_rope_is_let_go(tracker: Tracker, scene: HangingRope) -> None:
    for k in range(3):
        feed(tracker, scene, START + k * STEP)
    place = scene.gripper.copy()
    for k in range(3, 12):  # the gripper leaves upwards, the rope stays
        stamp = START + k * STEP
        tracker.add_grip(stamp, place[None] + [[0.0, 0.0, 0.02 * (k - 2)]], scene.grip(0)["rotation"], np.array([True]))
        for name, frame in scene.frames(stamp).items():
            tracker.add_frame(name, frame)
        estimate = tracker.step()
    assert estimate is not None
    assert np.linalg.norm(estimate.tracks.position - scene.truth(26), axis=-1).mean() < 0.008


def test_a_moved_camera_is_named_and_outvoted(tracker: Tracker, scene: HangingRope) -> None:
    for k in range(6):
        stamp = START + k * STEP
        tracker.add_grip(**scene.grip(stamp))
        for name, frame in scene.frames(stamp).items():
            pose = frame.world_from_camera.copy()
            if name == "cam1" and k >= 3:  # believed to be where it is not: about 1 degree at 1 m
                pose[:3, 3] += 0.017 * pose[:3, 0]
            tracker.add_frame(name, dataclasses.replace(frame, world_from_camera=pose))
        estimate = tracker.step()
        assert estimate is not None
        assert (estimate.odd_camera() is not None) == (k >= 3)
    odd = estimate.odd_camera()
    assert odd is not None and odd[0] == "cam1" and 0.008 < odd[1] < 0.02
    assert np.linalg.norm(estimate.tracks.position - scene.truth(26), axis=-1).mean() < 0.008


def test_nothing_to_see_is_no_estimate(scene: HangingRope) -> None:
    empty = dataclasses.replace(CONFIG, workspace=Workspace((0.3, 0.3, 0.0), (0.5, 0.5, 0.5)))
    tracker = Tracker(empty, ["cam0"])
    assert tracker.step() is None
    tracker.add_frame("cam0", scene.frames(START)["cam0"])
    assert tracker.step() is None and tracker.searching


def test_bad_input_is_named(tracker: Tracker, scene: HangingRope) -> None:
    with pytest.raises(ConfigError, match="cameras; got none; allowed: 1 to 8"):
        Tracker(CONFIG, [])
    with pytest.raises(ConfigError, match="1 to 8"):
        Tracker(CONFIG, [f"cam{i}" for i in range(9)])
    with pytest.raises(ConfigError, match="workspace box"):
        Tracker(dataclasses.replace(CONFIG, workspace=Workspace((0, 0, 0), (1, -1, 1))), ["cam0"])
    frame = scene.frames(START)["cam0"]
    with pytest.raises(InputError, match="unknown camera 'cam7'"):
        tracker.add_frame("cam7", frame)
    for change, words in (
        ({"depth": np.full_like(frame.depth, np.nan)}, "cam0: no pixel has a depth"),
        ({"depth": 1000.0 * frame.depth}, "cam0: implausible depth, are these millimetres[?].*in metres, or 16UC1"),
        ({"depth": frame.depth[:-1]}, "cam0: colour and depth do not fit"),
        ({"intrinsics": np.zeros((3, 3))}, "cam0: not calibrated"),
        ({"world_from_camera": np.full((4, 4), np.nan)}, "cam0: its pose in world is missing"),
        ({"world_from_camera": 2.0 * np.eye(4)}, "cam0: its pose is not a rigid transform"),
    ):
        with pytest.raises(InputError, match=words):
            tracker.add_frame("cam0", dataclasses.replace(frame, **change))
    far = frame.depth.copy()
    far[:80] = 500.0
    tracker.add_frame("cam0", dataclasses.replace(frame, depth=far))  # wrong in a third of the rows: not the unit

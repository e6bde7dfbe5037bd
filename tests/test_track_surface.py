"""Sheets and volumes: flow, patches and rigidity on known motions; a patterned board that is really moved."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed")
pytest.importorskip("cv2", reason="OpenCV is not installed")

import mujoco

from pred_core.plant.appearance import cover, dress_spec, speckled_picture
from pred_core.plant.cameras import Cameras, ring_of_cameras
from pred_core.plant.rope import GROUND
from pred_core.track import surface_tracker
from pred_core.track.flow import depth_at, follow_pixels, gray_of
from pred_core.track.paper_rollout import PaperRollout
from pred_core.track.rigidity import RigidityGraph
from pred_core.track.surface_tracker import SurfaceConfig, spread
from pred_core.track.template import Templates
from pred_core.track.tracker import Tracker, TrackerConfig
from pred_core.track.workspace import Workspace
from pred_core.types import Array, CameraFrame

START, STEP = 1_000_000_000, 66_000_000  # [ns]
CONFIG = TrackerConfig(
    kind="sheet", workspace=Workspace((-0.5, -0.5, 0.02), (0.5, 0.5, 0.6)), surface=SurfaceConfig(particles=120)
)


class Board:
    """A printed board, 30 cm x 20 cm, that is put anywhere; two cameras of 320 x 240 on one side."""

    def __init__(self) -> None:
        spec = mujoco.MjSpec()
        spec.worldbody.add_geom(name=GROUND, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1])
        dress_spec(spec)
        cover(spec, "print", speckled_picture(np.random.default_rng(0), (0.8, 0.2, 0.2), 256, 12), 1.0, uniform=False)
        body = spec.worldbody.add_body(name="board", mocap=True, pos=[0, 0, 0.2])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.15, 0.1, 0.004], material="print")
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.cameras = Cameras(self.model, ring_of_cameras(2, (0.0, 0.0, 0.2), 0.8, 1.2, width=320, height=240))
        self.generator = np.random.default_rng(0)

    def frames(self, stamp: int, shift: Array, yaw: float) -> dict[str, CameraFrame]:
        """Pictures with the board moved by `shift` [m] and turned by `yaw` [rad]."""
        self.data.mocap_pos[0] = np.array([0.0, 0.0, 0.2]) + shift
        self.data.mocap_quat[0] = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        mujoco.mj_forward(self.model, self.data)
        return {n: self.cameras.frame(self.data, n, stamp, self.generator) for n in self.cameras.configs}


@pytest.fixture(scope="module")
def board() -> Iterator[Board]:
    made = Board()
    yield made
    made.cameras.close()


def speckle(shift: tuple[int, int] = (0, 0)) -> np.ndarray:
    """A smooth random picture (120, 160), moved by whole pixels (right, down)."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(4).normal(0.0, 1.0, (120, 160)), 2.0, mode="wrap")
    picture = 128 + 40 * noise / noise.std()
    return np.roll(np.clip(picture, 0, 255).astype(np.uint8), (shift[1], shift[0]), (0, 1))


def test_flow_finds_a_known_shift_and_refuses_what_is_hidden() -> None:
    after = speckle((4, 2))
    after[80:] = 128  # the lower part is covered
    pixel = np.array([[50.0, 40.0], [90.0, 30.0], [60.0, 100.0]])
    there, good = follow_pixels(speckle(), after, pixel, pixel)
    # A shift by whole pixels interpolates nothing: Lucas-Kanade ends where a step is below 0.01 px.
    np.testing.assert_allclose(there[:2] - pixel[:2], [[4.0, 2.0]] * 2, atol=0.01)
    assert good.tolist() == [True, True, False]


def test_first_seen_patch_corrects_a_wrong_pixel() -> None:
    templates = Templates.empty(2)
    pixel = np.array([[50.0, 40.0], [90.0, 60.0]])
    tangents = np.tile(np.eye(2), (2, 1, 1))
    templates.keep(speckle(), np.array([0, 1]), pixel, tangents, np.zeros((2, 3)))
    wrong = pixel + [[4.0 + 1.2, 2.0 - 0.9], [4.0 + 30.0, 2.0]]
    found, correlation = templates.match(speckle((4, 2)), np.array([0, 1]), wrong, tangents)
    # OpenCV interpolates at multiples of 1/32 px: half of one is 0.016 px.
    np.testing.assert_allclose(found[0], pixel[0] + [4.0, 2.0], atol=0.02)
    assert correlation[0] > 0.95 and correlation[1] == 0.0, "30 px off is no match"


def test_a_faint_print_is_an_anchor_and_a_plain_cloth_is_none() -> None:
    rng = np.random.default_rng(5)
    pixel, tangents = np.array([[50.0, 40.0], [90.0, 60.0]]), np.tile(np.eye(2), (2, 1, 1))
    for contrast, found in ((12.0, True), (0.5, False)):  # grey levels; the print of the benchmark's cloth has 12
        before, after = (
            np.clip(128 + contrast / 40.0 * (speckle(s).astype(float) - 128) + rng.normal(0.0, 1.0, (120, 160)), 0, 255)
            .round().astype(np.uint8) for s in ((0, 0), (4, 2))
        )  # fmt: skip
        templates = Templates.empty(2)
        templates.keep(before, np.array([0, 1]), pixel, tangents, np.zeros((2, 3)))
        place, correlation = templates.match(after, np.array([0, 1]), pixel + [4.7, 1.5], tangents)
        assert (correlation > 0.0).tolist() == [found, found]
        # Noise of 1 level and rounding in both pictures, 225 pixels, gradients of 4 levels a pixel: 1.5 / (4 * 15) =
        # 0.025 px in each direction; four of them.
        if found:
            np.testing.assert_allclose(place, pixel + [4.0, 2.0], atol=0.1)


def test_depth_at_an_edge_is_none() -> None:
    depth = np.ones((20, 20), np.float32)
    depth[:, 10:] = 1.5
    depth[4, 4] = np.nan
    found = depth_at(depth, np.array([[5.0, 4.0], [9.6, 10.0], [0.0, 0.0], [15.0, 15.0]]))
    np.testing.assert_allclose(found[[0, 3]], [1.0, 1.5])
    assert np.isnan(found[1]) and np.isnan(found[2])


def test_rigid_motion_of_a_few_carries_all() -> None:
    x, y = np.meshgrid(np.arange(8) * 0.03, np.arange(6) * 0.03)
    rest = np.stack([x.ravel(), y.ravel(), np.zeros(48)], axis=-1)
    c, s = np.cos(0.4), np.sin(0.4)
    truth = rest @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [0.1, 0.0, 0.05]
    weight = np.full(48, 1e-6)
    weight[[0, 7, 40, 47]] = 10.0
    found = RigidityGraph(rest).solve(rest, truth * (weight > 1)[:, None], weight, 2.0, rounds=60)
    # The corners' motion reaches the middle. The 44 others pull with 1e-6 each towards 0, 0.3 m away, the corners with
    # 40 together: 0.3 um, and some times that where it bends.
    assert np.linalg.norm(found - truth, axis=-1).max() < 2e-6


def test_spread_covers_evenly() -> None:
    points = np.random.default_rng(0).uniform(0.0, 0.3, (5000, 3)) * [1.0, 1.0, 0.0]
    found = spread(points, 100)
    from scipy.spatial import cKDTree

    gap = cKDTree(found).query(found, k=2)[0][:, 1]
    # Discs around the 100 cover 0.3 m x 0.3 m: they are wider, and their middles farther apart, than 16.9 mm. Each is
    # then the mean of the 12 points around it, a disc of 8.3 mm: moved by 8.3 / 2 / sqrt(12) = 1.2 mm in each
    # direction, so that two of them, two deviations each, come nearer by 4.8 mm.
    assert gap.min() > 0.012


def test_board_is_followed_and_the_rollout_drifts(board: Board) -> None:
    tracker = Tracker(CONFIG, ["cam0", "cam1"])
    error, drift = [], []
    first = paper = None
    for k in range(12):
        shift, yaw = np.array([0.008, 0.004, 0.0]) * k, 0.02 * k  # 0.14 m/s
        frames = board.frames(START + k * STEP, shift, yaw)
        for name, frame in frames.items():
            tracker.add_frame(name, frame)
        estimate = tracker.step()
        assert estimate is not None
        first = estimate.tracks.position if first is None else first
        paper = paper or PaperRollout(first)
        rolled = paper.step(frames, [tracker.mask.view(n, f) for n, f in frames.items()])
        c, s = np.cos(yaw), np.sin(yaw)
        truth = first @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + shift
        error.append(np.linalg.norm(estimate.tracks.position - truth, axis=-1).mean())
        drift.append(np.linalg.norm(rolled - truth, axis=-1).mean())
    assert estimate.tracks.visible.mean() > 0.8 and estimate.status == "tracking"
    # A pixel is 2.7 mm: patches and depth are known to a fraction of it. What adds up flow alone walks away from there.
    assert max(error) < 0.5 * 0.0027
    assert 2.0 * error[-1] < drift[-1]


class Points:
    """A model's stand-in: Lucas-Kanade from picture to picture, which answers every second time."""

    started: list[int] = []  # how many points each time, of all cameras

    def __init__(self) -> None:
        self.count = 0

    def another(self) -> Points:
        return Points()

    def start(self, rgb: np.ndarray, pixel: Array) -> None:
        self.before, self.pixel = gray_of(rgb), pixel.copy()
        self.started.append(len(pixel))

    def follow(self, rgb: np.ndarray) -> tuple[Array, np.ndarray]:
        gray = gray_of(rgb)
        self.pixel, good = follow_pixels(self.before, gray, self.pixel, self.pixel, largest=5.0)
        self.before, self.count = gray, self.count + 1
        return self.pixel, good & (self.count % 2 == 0)


def test_a_models_points_are_used_where_there_are_some(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without any flow of its own the tracker follows what the model follows; without the model too it is blind."""
    monkeypatch.setattr(surface_tracker, "follow_pixels", lambda *a: (a[3], np.zeros(len(a[3]), bool)))
    monkeypatch.setattr(Points, "started", [])
    seen: dict[str, list[int]] = {"model": [], "nothing": []}
    for name, follower in (("model", Points()), ("nothing", None)):
        tracker, first = Tracker(CONFIG, ["cam0", "cam1"], follower=follower), np.zeros(0)
        for k in range(9):
            shift = np.array([0.004, 0.002, 0.0]) * k
            for camera, frame in board.frames(START + k * STEP, shift, 0.0).items():
                tracker.add_frame(camera, frame)
            estimate = tracker.step()
            assert estimate is not None
            first = estimate.tracks.position if k == 0 else first
            if estimate.tracks.visible.mean() > 0.5 and k:
                seen[name].append(k)
                assert np.linalg.norm(estimate.tracks.position - first - shift, axis=-1).mean() < 0.5 * 0.0027
    assert seen == {"model": [1, 3, 5, 7], "nothing": []}  # the picture that it begins with is asked for too
    assert len(Points.started) == 2 and min(Points.started) > 60  # once a camera, most of what it sees


def test_a_model_begins_anew_where_it_follows_too_little(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    """One camera does not know the depth of half of the board at first."""
    monkeypatch.setattr(Points, "started", [])
    tracker = Tracker(CONFIG, ["cam0", "cam1"], follower=Points())
    for k in range(4):
        for camera, frame in board.frames(START + k * STEP, np.zeros(3), 0.0).items():
            if camera == "cam1" and k < 2:
                frame.depth[:, : frame.depth.shape[1] // 2] = np.nan
            tracker.add_frame(camera, frame)
        assert tracker.step() is not None
    whole, half, anew = Points.started
    assert half < 0.6 * whole and anew > 0.8 * whole


def test_covered_sheet_is_unseen_then_lost(board: Board) -> None:
    tracker = Tracker(CONFIG, ["cam0", "cam1"])
    for k in range(22):
        frames = board.frames(START + k * STEP, np.zeros(3), 0.0)
        for name, frame in frames.items():
            if k >= 3:
                frame.depth[:] = 0.2
                frame.rgb[:] = 0
            tracker.add_frame(name, frame)
        estimate = tracker.step()
        if k == 5:
            assert estimate is not None and not estimate.tracks.visible.any() and estimate.status == "tracking"
        if estimate is not None and estimate.status == "lost":
            break
    assert tracker.searching, "1.0 s without a measurement"

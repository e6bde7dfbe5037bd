"""Adapters of learned models: without weights one clear line; with a model the tensors they promise."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pred_core.errors import ConfigError
from pred_core.track.learned_masks import MaskFollower, NamedObject, TextDetector, load_named_object
from pred_core.track.learned_points import CoTracker3, TapNext, load_points
from pred_core.track.line_config import LineConfig
from pred_core.track.settings import TrackerSettings, make_tracker
from pred_core.track.tracker import Tracker, TrackerConfig
from pred_core.track.workspace import Workspace

RGB = np.full((32, 48, 3), 100, np.uint8)
MISSING = [name for name in ("transformers", "torchvision") if importlib.util.find_spec(name) is None]


@pytest.mark.parametrize("adapter", [TextDetector, MaskFollower])
def test_masks_without_weights_name_the_folder(adapter: type, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no weights on disk.*config.json"):
        adapter(tmp_path / "sam")


def test_points_without_weights_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="CoTracker3: no weights on disk"):
        CoTracker3(tmp_path, tmp_path / "scaled_online.pth")
    with pytest.raises(ConfigError, match="TAPNext: no weights on disk"):
        TapNext(tmp_path / "tapnext.pt")
    (tmp_path / "scaled_online.pth").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"no checkout of co-tracker.*hubconf.py"):
        CoTracker3(tmp_path, tmp_path / "scaled_online.pth")


class FakeCoTracker:
    """The interface of CoTracker3 online: every point moves by one pixel a picture."""

    step = 2

    def __call__(self, video: torch.Tensor, is_first_step: bool, queries: torch.Tensor) -> Any:
        assert video.shape[2:] == (3, 32, 48) and video.max() == 100.0
        if is_first_step:
            return None, None
        moved = queries[:, None, :, 1:] + torch.arange(video.shape[1])[None, :, None, None]
        return moved, torch.ones(moved.shape[:3])


def test_cotracker_answers_every_half_window_with_the_newest_picture() -> None:
    follower = CoTracker3(model=FakeCoTracker())
    with pytest.raises(ConfigError, match="Call start first"):
        follower.follow(RGB)
    follower.start(RGB, np.array([[3.0, 5.0]]))
    for _ in range(2):
        place, visible = follower.follow(RGB)
        assert place.tolist() == [[3.0, 5.0]] and visible.tolist() == [False]  # no answer for this picture
    place, visible = follower.follow(RGB)  # the fourth picture: a whole window of four
    assert place.tolist() == [[6.0, 8.0]] and visible.tolist() == [True]


class FakeTapNext:
    """The interface of TAPNext: squares of 256, y before x, a state handed on; points move right by two pixels."""

    def __call__(self, video: torch.Tensor, query_points: Any = None, state: Any = None) -> Any:
        assert video.shape == (1, 1, 256, 256, 3) and abs(float(video.mean()) - (100 / 127.5 - 1)) < 1e-6
        yx = query_points[..., 1:] if state is None else state + torch.tensor([0.0, 2.0])
        return yx[:, None], None, torch.ones(1, 1, yx.shape[1], 1), yx


def test_tapnext_swaps_its_axes_and_keeps_its_state() -> None:
    follower = TapNext(model=FakeTapNext())
    follower.start(RGB, np.array([[10.0, 4.0]]))
    step = 2.0 * 48 / 256  # of a square's pixel, in a picture of 48 columns
    for k in (1, 2):
        place, visible = follower.follow(RGB)
        assert place == pytest.approx(np.array([[10.0 + k * step, 4.0]]), abs=1e-4) and visible.tolist() == [True]
    with pytest.raises(ConfigError, match="Call start first"):
        follower.another().follow(RGB)


def test_points_are_asked_for_by_name_and_folder(tmp_path: Path) -> None:
    """What `pred track` and the node `tracker` say to `points` and `points_folder`."""
    sheet = TrackerSettings(kind="sheet", points="cotracker3", points_folder=str(tmp_path))
    with pytest.raises(ConfigError, match="CoTracker3: no weights on disk.*scaled_online.pth"):
        make_tracker(sheet)
    with pytest.raises(ConfigError, match="TAPNext: no weights on disk"):
        make_tracker(dataclasses.replace(sheet, points="tapnext"))
    with pytest.raises(ConfigError, match="'tapnext' for a line.*kind: sheet or volume"):
        make_tracker(TrackerSettings(points="tapnext", points_folder=str(tmp_path)))
    with pytest.raises(ConfigError, match="'points_folder' without 'points'"):
        make_tracker(dataclasses.replace(sheet, points=""))
    with pytest.raises(ConfigError, match="'points_folder' is empty; allowed: the folder with the weights of tapnext"):
        make_tracker(TrackerSettings(kind="sheet", points="tapnext"))
    for name in ("a.npz", "b.pt"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(ConfigError, match=r"several checkpoints; got a.npz, b.pt"):
        load_points("tapnext", tmp_path)


@pytest.mark.skipif(bool(MISSING), reason=f"{' and '.join(MISSING)} not installed (optional, in none of the extras)")
def test_small_random_sam2_follows_a_box(tmp_path: Path) -> None:
    import transformers

    config = transformers.Sam2VideoConfig()
    transformers.Sam2VideoModel(config).save_pretrained(tmp_path)
    transformers.Sam2VideoProcessor(
        image_processor=transformers.Sam2ImageProcessor(), video_processor=transformers.Sam2VideoVideoProcessor()
    ).save_pretrained(tmp_path)
    follower = MaskFollower(tmp_path)
    assert follower.start(RGB, np.array([4.0, 4.0, 20.0, 20.0])).shape == RGB.shape[:2]
    assert follower.follow(RGB).shape == RGB.shape[:2]


class Finder:
    """Finds one box where a picture has a bright column; counts how often it is asked."""

    asked = 0

    def find(self, rgb: np.ndarray, text: str) -> tuple[np.ndarray, np.ndarray]:
        self.asked += 1
        assert text == "white rope"
        columns = np.nonzero(rgb[0, :, 0] > 200)[0]
        return np.array([[columns[0], 0.0, columns[-1] + 1.0, 8.0]] if len(columns) else []).reshape(-1, 4), np.ones(1)


class Bright:
    """Follows what is bright."""

    def another(self) -> Bright:
        return Bright()

    def start(self, rgb: np.ndarray, box: np.ndarray) -> np.ndarray:
        assert box.shape == (4,)
        return self.follow(rgb)

    def follow(self, rgb: np.ndarray) -> np.ndarray:
        return np.asarray(rgb[..., 0] > 200)


def test_a_named_object_is_found_once_a_camera_and_again_when_it_is_lost() -> None:
    finder = Finder()
    masks = NamedObject("white rope", finder, Bright())  # type: ignore[arg-type]
    there, gone = np.zeros((8, 6, 3), np.uint8), np.zeros((8, 6, 3), np.uint8)
    there[:, 2:4] = 255
    for camera in ("cam0", "cam1"):
        for _ in range(3):
            assert np.array_equal(masks.mask(camera, there), there[..., 0] > 200)
    assert finder.asked == 2
    assert not masks.mask("cam0", gone).any() and finder.asked == 2
    assert not masks.mask("cam0", gone).any() and finder.asked == 3
    assert masks.mask("cam0", there).any() and finder.asked == 4
    masks.reset()
    assert masks.mask("cam1", there).any() and finder.asked == 5


def test_a_mask_keeps_the_tracker_to_the_object() -> None:
    """Masks that see nothing leave nothing to track; those that see all change nothing."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    from track_scenes import LENGTH, STEP, HangingRope

    class Given:
        """The same everywhere."""

        def __init__(self, value: bool):
            self.value = value

        def mask(self, camera: str, rgb: np.ndarray) -> np.ndarray:
            return np.full(rgb.shape[:2], self.value)

        def reset(self) -> None:
            """Nothing is kept."""

    config = TrackerConfig(
        workspace=Workspace((-0.5, -0.5, 0.0), (0.5, 0.5, 0.9)), line=LineConfig(particles=26, length=LENGTH)
    )
    scene = HangingRope()
    found = {}
    for name, masks in (("none", None), ("all", Given(True)), ("nothing", Given(False))):
        tracker = Tracker(config, list(scene.cameras.configs), masks)
        scene.generator = np.random.default_rng(0)
        for k in range(3):
            stamp = 20_000_000_000 + k * STEP
            tracker.add_grip(**scene.grip(stamp))
            for camera, frame in scene.frames(stamp).items():
                tracker.add_frame(camera, frame)
            found[name] = tracker.step()
    scene.close()
    assert found["none"] is not None and found["nothing"] is None
    assert np.array_equal(found["all"].tracks.position, found["none"].tracks.position)


def test_a_tracker_without_weights_says_where_they_are_missed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Grounding DINO: no weights on disk"):
        load_named_object("rope", tmp_path, tmp_path)
    with pytest.raises(ConfigError, match="need the object's name"):
        load_named_object(" ", tmp_path, tmp_path)

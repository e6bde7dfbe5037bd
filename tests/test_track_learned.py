"""Adapters of learned models: without weights one clear line; with a model the tensors they promise."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pred_core.errors import ConfigError
from pred_core.track.learned_masks import MaskFollower, TextDetector
from pred_core.track.learned_points import CoTracker3, TapNext

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
    assert follower.follow(RGB)[0].tolist() == [[3.0, 5.0]]
    assert follower.follow(RGB)[0].tolist() == [[3.0, 5.0]]
    place, visible = follower.follow(RGB)  # the fourth picture: a whole window of four
    assert place.tolist() == [[6.0, 8.0]] and visible.tolist() == [True]


class FakeTapNext:
    """The interface of TAPNext: y before x, a state handed on; every point moves right by two pixels."""

    def __call__(self, video: torch.Tensor, query_points: Any = None, state: Any = None) -> Any:
        assert video.shape == (1, 1, 32, 48, 3) and abs(float(video.mean()) - (100 / 127.5 - 1)) < 1e-6
        yx = query_points[..., 1:] if state is None else state + torch.tensor([0.0, 2.0])
        return yx[:, None], None, torch.ones(1, 1, yx.shape[1], 1), yx


def test_tapnext_swaps_its_axes_and_keeps_its_state() -> None:
    follower = TapNext(model=FakeTapNext())
    follower.start(RGB, np.array([[10.0, 4.0]]))
    assert follower.follow(RGB)[0].tolist() == [[12.0, 4.0]]
    assert follower.follow(RGB)[0].tolist() == [[14.0, 4.0]]


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

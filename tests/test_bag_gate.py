"""The data gate names the planted fault and is silent on clean data."""

import dataclasses

import numpy as np
import pytest
from bag_examples import line_episode

from pred_core.bag.gate import EpisodeQuality, examine_all
from pred_core.types import Episode


def _spoiled(change=None) -> EpisodeQuality:
    """Findings on the second of three episodes, the only one that `change` touches."""
    episodes = [line_episode(60, 8) for _ in range(3)]
    if change is not None:
        change(episodes[1])
    return examine_all(lambda: iter(episodes))[1]


def test_clean_data_are_not_flagged() -> None:
    quality = _spoiled()
    assert quality.flags == ()
    assert quality.speed_max == pytest.approx(1.0, abs=1e-4)  # float32 of 0.01 m steps
    assert quality.stretch_max == pytest.approx(0.0, abs=1e-5)


def test_a_glitch_is_one_marker_off_its_line() -> None:
    def jump(episode: Episode) -> None:
        episode.position[20, 3, 2] += 0.015  # neighbours of that frame are 7.5 mm off, below the limit of 10 mm

    quality = _spoiled(jump)
    assert quality.glitch_marker_frames == 1
    assert any("1 marker frames jump" in f for f in quality.flags)


def test_markers_that_change_places_and_back() -> None:
    def swap(episode: Episode) -> None:
        episode.position[20:30, [3, 4]] = episode.position[20:30, [4, 3]]

    quality = _spoiled(swap)
    assert quality.swapped_frames == 2
    assert "change places at 2 frames" in quality.flags[0]


def test_a_stretched_edge() -> None:
    def stretch(episode: Episode) -> None:
        episode.position[10:15, 4:, 0] += 0.03  # the edge of 0.1 m becomes 0.13 m

    quality = _spoiled(stretch)
    assert quality.stretch_max == pytest.approx(0.3, abs=1e-5) and quality.stretch_frames == 5


def test_a_marker_that_has_slipped_for_the_whole_episode() -> None:
    def slip(episode: Episode) -> None:
        episode.position[:, 3, 0] += 0.01

    quality = _spoiled(slip)
    assert quality.slip_max == pytest.approx(0.1, abs=1e-5)
    assert any("slipped" in f for f in quality.flags) and quality.glitch_marker_frames == 0


def test_drop_outs_and_lost_frames() -> None:
    def hide(episode: Episode) -> None:
        for frames, particles in ((slice(5, 25), slice(2, 4)), (slice(40, 41), slice(None))):
            episode.position[frames, particles] = np.nan
            episode.tracks.visible[frames, particles] = False

    quality = _spoiled(hide)
    assert quality.hidden == pytest.approx((20 * 2 + 8) / (60 * 8))
    assert quality.lost_frames == 1 and any("10.0% not measured" in f for f in quality.flags)


def test_implausible_speed() -> None:
    def throw(episode: Episode) -> None:
        episode.position[30:, :, 1] += 0.2  # 0.21 m in a frame of 10 ms

    assert _spoiled(throw).speed_max == pytest.approx(21.0, abs=1e-3)


def test_irregular_frames() -> None:
    def late(episode: Episode) -> None:
        episode.stamps[30] += 4_000_000

    assert _spoiled(late).jitter_max == pytest.approx(0.4, abs=1e-9)


def test_a_sheet_uses_nearest_neighbours_and_other_ids_are_said() -> None:
    episodes = []
    for _ in range(2):
        episode = line_episode(30, 9)
        grid = np.stack(np.meshgrid(np.arange(3), np.arange(3)), -1).reshape(-1, 2) * 0.05
        episode.position[:, :, 0], episode.position[:, :, 2] = grid[:, 0], grid[:, 1]
        episodes.append(dataclasses.replace(episode, object=dataclasses.replace(episode.object, kind="sheet")))
    other = dataclasses.replace(
        episodes[1], tracks=dataclasses.replace(episodes[1].tracks, id=episodes[1].tracks.id + 1)
    )
    first, second = examine_all(lambda: iter([episodes[0], other]))
    assert first.flags == ()
    assert second.flags == ("its particle ids differ from those of the first episode",)

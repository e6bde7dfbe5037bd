"""Episodes to windows: alignment by id, honest hold-out, starts only where everything is measured."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from residual_case import PERIOD, Falling, episodes, line_body
from torch import Tensor

from pred_core.errors import DatasetError, DivergenceError
from pred_core.identify.windows import draw_windows
from pred_core.train import Recording, align
from pred_core.train.outliers import backbone_error, leave_out
from pred_core.train.recordings import gather, split_groups, start_frames, window_index
from pred_core.types import Episode, Grip, State


def recordings(number: int = 3, frames: int = 12) -> list[Recording]:
    return [align(e, line_body(), PERIOD) for e in episodes(Falling(), number, frames, seed=0)]


def with_tracks(episode: Episode, **changes: object) -> Episode:
    return dataclasses.replace(episode, tracks=dataclasses.replace(episode.tracks, **changes))


def test_columns_follow_the_ids_of_the_body() -> None:
    (episode,) = episodes(Falling(), 1, 5, seed=0)
    back = np.arange(6)[::-1]
    held = np.array([0, -1, -1, -1, -1, -1], np.int32)
    reversed_ = dataclasses.replace(
        with_tracks(episode, position=episode.position[:, back], id=episode.tracks.id[back]), held=held[back]
    )
    recording = align(reversed_, line_body(), PERIOD)
    assert np.allclose(recording.position.numpy(), episode.position)
    assert recording.held[0].tolist() == held.tolist()


def test_wrong_rate_and_missing_particles_are_refused() -> None:
    (episode,) = episodes(Falling(), 1, 5, seed=0)
    with pytest.raises(DatasetError, match=r"0\.02 s; allowed: 0\.01 s"):
        align(episode, line_body(), 0.01)
    with pytest.raises(DatasetError, match="no id 6"):
        align(episode, line_body(7), PERIOD)


def test_a_gripper_that_opened_holds_nothing_more() -> None:
    (episode,) = episodes(Falling(), 1, 5, seed=0)
    closed = torch.tensor([[True], [True], [False], [True], [True]])
    grips = Grip(episode.grips.position, episode.grips.rotation, closed)
    held = np.array([0, -1, -1, -1, -1, -1], np.int32)
    recording = align(dataclasses.replace(episode, grips=grips, held=held), line_body(), PERIOD)
    assert recording.held[:, 0].tolist() == [0, 0, -1, -1, -1]


def test_windows_start_where_everything_is_measured() -> None:
    (episode,) = episodes(Falling(), 1, 10, seed=0)
    position = episode.position.copy()
    position[3, 2] = np.nan
    recording = align(with_tracks(episode, position=position), line_body(), PERIOD)
    # 4 periods after the start must exist: starts 1..5; 3 and 4 touch the hole.
    assert window_index([recording], 4, 1)[:, 1].tolist() == [1, 2, 5]
    batch = gather([recording], torch.tensor([[0, 2]]), 4, PERIOD, torch.device("cpu"))
    assert batch.seen[0, 0].tolist() == [True, True, False, True, True, True]
    assert batch.target[0, 0, 2].tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(DatasetError, match="20 periods"):
        window_index([recording], 20, 1)


def test_windows_never_start_where_a_gripper_has_closed_anew() -> None:
    # Closed at frames 0-2 and again at 5-6: what it holds then is not told. Frame 0 has no velocity.
    (episode,) = episodes(Falling(), 1, 10, seed=0)
    closed = torch.tensor([1, 1, 1, 0, 0, 1, 1, 0, 0, 0], dtype=torch.bool)[:, None]
    grips = Grip(episode.grips.position, episode.grips.rotation, closed)
    recording = align(dataclasses.replace(episode, grips=grips), line_body(), PERIOD)
    assert torch.nonzero(start_frames(recording)).flatten().tolist() == [1, 2, 3, 4, 7, 8, 9]
    assert window_index([recording], 2, 1)[:, 1].tolist() == [1, 2, 3, 4, 7]
    assert draw_windows([recording], 2, 100, torch.Generator().manual_seed(0))[:, 1].tolist() == [1, 2, 3, 4, 7]


def test_batch_reproduces_the_recording() -> None:
    data = recordings()
    batch = gather(data, torch.tensor([[0, 1], [2, 4]]), 5, PERIOD, torch.device("cpu"))
    assert batch.start.position[1].equal(data[2].position[4])
    assert batch.target[:, 1].equal(data[2].position[5:10])
    base = Falling()  # made the data, so from the right start it meets every target
    got = base.rollout(base.start(batch.start, batch.start_grip), batch.grips)
    assert torch.allclose(got, batch.target, atol=1e-5)


def test_outliers_are_those_the_backbone_fails_on() -> None:
    # Four throws in vacuum and one in air: free fall explains four of them exactly.
    data = recordings(4) + [align(episodes(Falling(drag=3.0), 1, 12, seed=7)[0], line_body(), PERIOD)]
    error = backbone_error(Falling(drag=0.1), data)
    assert error[:4].max() < 0.1 * error[4]  # a wrong drag of 0.1/s against one of 2.9/s
    kept, left_out = leave_out(Falling(drag=0.1), data, factor=3.0)
    assert [r.name for r in kept] == ["throw0", "throw1", "throw2", "throw3"] and len(left_out) == 1
    assert left_out[0].error_mm == pytest.approx(float(error[4])) and left_out[0].median_mm < 0.1 * float(error[4])
    assert leave_out(Falling(), data, factor=0.0) == (data, [])


def test_groups_are_never_split() -> None:
    data = [dataclasses.replace(r, group=i // 3) for i, r in enumerate(recordings(9, 4))]
    fit, held_out = split_groups(data, 0.3, torch.Generator().manual_seed(0))
    assert len(fit) == 6 and len(held_out) == 3  # one of three groups
    assert {r.group for r in fit}.isdisjoint(r.group for r in held_out)
    assert split_groups(data, 0.0, torch.Generator())[1] == []
    with pytest.raises(DatasetError, match="--holdout 0"):
        split_groups(data[:3], 0.3, torch.Generator())


class Fragile(Falling):
    """Diverges where a recording starts faster than 100 m/s: a marker that jumped."""

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """By steps. Raises: DivergenceError."""
        if bool((state.velocity.norm(dim=-1) > 100.0).any()):
            raise DivergenceError("too fast")
        return super().rollout(state, grips)


def test_a_recording_the_backbone_diverges_on_is_left_out_and_named() -> None:
    data = recordings(4)
    position = data[2].position.clone()
    position[1, 3] += 5.0  # a marker jumps 5 m between the first two frames
    data[2] = dataclasses.replace(data[2], position=position)
    error = backbone_error(Fragile(drag=0.1), data)
    kept, left_out = leave_out(Fragile(drag=0.1), data, factor=3.0)
    assert torch.isfinite(error).all() and [r.name for r in left_out] == ["throw2"]
    assert [r.name for r in kept] == ["throw0", "throw1", "throw3"]

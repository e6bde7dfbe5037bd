"""Episodes as dense tensors in the particle order of a body, cut into windows, gathered into batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.calibration import Calibration
from pred_core.errors import DatasetError
from pred_core.types import Body, Episode, Grip, State

PERIOD_TOLERANCE = 0.02  # relative difference of a twin's period and the frames' that clocks explain


@dataclass(frozen=True)
class Recording:
    """One episode in the body's particle order."""

    name: str
    group: int  # recordings of one group must not be split
    position: Tensor  # (T, N, 3) [m] world, NaN where not measured
    grips: Grip  # leading axis T
    held: Tensor  # (T, N) int32; a gripper that has opened holds nothing more
    estimated: Tensor | None = None  # (N,) bool: never measured, positions are estimates (`bag.unseen`); None: none


@dataclass(frozen=True)
class Batch:
    """B windows as one batched state."""

    start: State  # leading axis B
    start_grip: Grip  # leading axis B
    grips: Grip  # leading axes K, B
    target: Tensor  # (K, B, N, 3) [m] world, 0 where not measured
    seen: Tensor  # (K, B, N) bool


def align(episode: Episode, body: Body, period: float, calibration: Calibration | None = None) -> Recording:
    """The episode in the body's order of particles, corrected by the calibration of the twin it is for.

    Raises: DatasetError if a particle of the body is not in the tracks, or the rates differ.
    """
    if abs(episode.period / period - 1.0) > PERIOD_TOLERANCE:
        raise DatasetError(
            f"{episode.name}: frames do not come at the twin's period",
            got=f"{episode.period:.6g} s",
            allowed=f"{period:.6g} s within {PERIOD_TOLERANCE:.0%}",
            next_step="Identify a twin at this rate",
        )
    if calibration is not None:
        episode = calibration.correct(episode)
    column = {int(k): i for i, k in enumerate(episode.tracks.id)}
    missing = [int(k) for k in body.id if int(k) not in column]
    if missing:
        raise DatasetError(
            f"{episode.name}: particles of the twin are not in the tracks",
            got=f"no id {', '.join(map(str, missing[:5]))}",
            next_step="Identify a twin from this data set",
        )
    order = np.array([column[int(k)] for k in body.id])
    held = torch.as_tensor(episode.held[order], dtype=torch.int32)
    kept = episode.grips.closed.cumprod(dim=0).bool()[:, held.clamp_min(0).long()]
    return Recording(
        name=episode.name,
        group=episode.recording,
        position=torch.as_tensor(episode.position[:, order], dtype=torch.float32),
        grips=episode.grips,
        held=torch.where(kept & (held >= 0), held, -1).to(torch.int32),
        estimated=torch.as_tensor(~np.asarray(episode.tracks.visible.any(axis=0))[order]),
    )


def split_groups(
    recordings: Sequence[Recording], share: float, generator: torch.Generator
) -> tuple[list[Recording], list[Recording]]:
    """Recordings to fit on and recordings held out, split by group. share 0: nothing is held out.

    Raises: DatasetError if a single group would have to be split.
    """
    groups = sorted({r.group for r in recordings})
    if not groups:
        raise DatasetError("there are no train episodes", next_step="Give some episodes 'split: train'")
    if share == 0.0:
        return list(recordings), []
    if len(groups) < 2:
        raise DatasetError(
            "one recording cannot be both trained on and held out",
            got="1 recording",
            next_step="Record another one, or train with --holdout 0 (keeps the last weights)",
        )
    number = min(max(1, round(share * len(groups))), len(groups) - 1)
    drawn = torch.randperm(len(groups), generator=generator)[:number].tolist()
    chosen = {groups[i] for i in drawn}
    return [r for r in recordings if r.group not in chosen], [r for r in recordings if r.group in chosen]


def start_frames(recording: Recording) -> Tensor:
    """(T,) bool: frames a window may start at, for fitting and for training alike.

    Every particle is measured there and at the frame before, and what each gripper holds is known: it is told for
    the first frame; after a gripper has closed anew, it is not known until it opens again.
    """
    closed = recording.grips.closed
    usable = (closed == closed.cumprod(dim=0).bool()).all(dim=1)
    whole = torch.isfinite(recording.position).flatten(1).all(dim=1)
    usable &= whole
    usable[1:] &= whole[:-1]
    usable[0] = False
    return usable


def window_index(recordings: Sequence[Recording], steps: int, stride: int) -> Tensor:
    """(M, 2) int64: recording and start frame of every window of `steps` periods.

    A window starts at one of `start_frames`. Raises: DatasetError if there is none.
    """
    rows = []
    for r, recording in enumerate(recordings):
        frames = torch.arange(1, max(len(recording.position) - steps, 1), stride)
        frames = frames[start_frames(recording)[frames]]
        rows.append(torch.stack((torch.full_like(frames, r), frames), dim=-1))
    index = torch.cat(rows) if rows else torch.zeros(0, 2, dtype=torch.int64)
    if not len(index):
        longest = max((len(r.position) for r in recordings), default=0)
        raise DatasetError(
            f"no recording has a window of {steps} periods with two complete frames before it",
            got=f"the longest recording has {longest} frames",
            next_step="Use a shorter --rollout",
        )
    return index


def beginnings(index: Tensor) -> Tensor:
    """The first window of each recording in `index` (M, 2)."""
    recording = index[:, 0]
    first = torch.cat((torch.ones(1, dtype=torch.bool), recording[1:] != recording[:-1]))
    return index[first]


def gather(recordings: Sequence[Recording], index: Tensor, steps: int, period: float, device: torch.device) -> Batch:
    """The windows `index` (B, 2) as one batch; start velocity by backward difference."""
    starts, grips, before, targets = [], [], [], []
    for r, frame in index.tolist():
        recording = recordings[r]
        now, last = recording.position[frame], recording.position[frame - 1]
        starts.append((now, (now - last) / period, recording.held[frame]))
        before.append(recording.grips.at(frame))
        grips.append(recording.grips.span(frame + 1, frame + 1 + steps))
        target = recording.position[frame + 1 : frame + 1 + steps]
        if recording.estimated is not None:
            target = torch.where(recording.estimated[:, None], torch.nan, target)
        targets.append(target)
    position, velocity, held = (torch.stack(parts).to(device) for parts in zip(*starts, strict=True))
    target = torch.stack(targets, dim=1).to(device)
    seen = torch.isfinite(target).all(dim=-1)
    return Batch(
        start=State(position, velocity, held),
        start_grip=_stack(before, 0, device),
        grips=_stack(grips, 1, device),
        target=torch.where(seen.unsqueeze(-1), target, 0.0),
        seen=seen,
    )


def _stack(grips: list[Grip], dim: int, device: torch.device) -> Grip:
    numbers = {g.position.shape[-2] for g in grips}
    if len(numbers) > 1:
        raise DatasetError("recordings differ in the number of grippers", got=sorted(numbers), allowed="one number")
    return Grip(
        torch.stack([g.position for g in grips], dim).float().to(device),
        torch.stack([g.rotation for g in grips], dim).float().to(device),
        torch.stack([g.closed for g in grips], dim).to(device),
    )

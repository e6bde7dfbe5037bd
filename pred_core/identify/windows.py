"""Fixed windows of recordings: estimated starts, gripper poses, targets."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pred_core.errors import DatasetError
from pred_core.identify.starts import estimate_start
from pred_core.train.recordings import Recording, gather, start_frames
from pred_core.types import Grip, State


@dataclass(frozen=True)
class Windows:
    """W windows of K periods. One that its recording is too short for ends with frames in which nothing is seen."""

    start: State  # (W, N, 3)
    start_grip: Grip  # (W, G, ...)
    grips: Grip  # (K, W, G, ...)
    target: Tensor  # (K, W, N, 3) [m] world, 0 where not seen
    seen: Tensor  # (K, W, N) bool, particles that were measured and not held
    held: Tensor  # (K, W, N) int32 gripper index at each target, -1 = free
    names: tuple[str, ...]  # (W,) episode of each window
    groups: tuple[int, ...]  # (W,) recording of each window; windows of one recording are not independent

    @property
    def count(self) -> int:
        """Number of windows W."""
        return len(self.names)


def make_windows(
    recordings: Sequence[Recording], index: Tensor, steps: int, period: float, noise: float | None
) -> Windows:
    """The windows `index` (W, 2). `noise` [m]: starts are estimated with it; None: raw from two frames."""
    padded = [_padded(r, int(index[index[:, 0] == n, 1].amax(0)) + 1 + steps) if n in index[:, 0] else r
              for n, r in enumerate(recordings)]  # fmt: skip
    batch = gather(padded, index, steps, period, torch.device("cpu"))
    start = batch.start
    if noise is not None:
        estimates = [estimate_start(recordings[r], f, period, noise) for r, f in index.tolist()]
        start = start.replace(
            position=torch.stack([e[0] for e in estimates]), velocity=torch.stack([e[1] for e in estimates])
        )
    held = torch.stack([padded[r].held[f + 1 : f + 1 + steps] for r, f in index.tolist()], dim=1)
    names = tuple(recordings[r].name for r, _ in index.tolist())
    groups = tuple(recordings[r].group for r, _ in index.tolist())
    return Windows(start, batch.start_grip, batch.grips, batch.target, batch.seen & (held < 0), held, names, groups)


def draw_windows(recordings: Sequence[Recording], steps: int, count: int, generator: torch.Generator) -> Tensor:
    """(W, 2) recording and start frame: at most `count` windows, spread over recordings, the same for a seed.

    Windows overlap by half; a recording shorter than `steps` gives one, from its beginning. Raises: DatasetError if
    no recording has two complete frames to start from.
    """
    pairs = [(r, f) for r, recording in enumerate(recordings) for f in _starts(recording, steps)]
    if not pairs:
        raise DatasetError(
            "no window to fit: no recording has two complete frames in a row before its last",
            got=f"{len(recordings)} recordings",
            next_step="Look at 'pred info' for particles that are never measured",
        )
    taken: dict[int, int] = {}
    ranked: list[tuple[int, int, int]] = []
    for n in torch.randperm(len(pairs), generator=generator).tolist():
        r = pairs[n][0]
        ranked.append((taken.get(r, 0), len(ranked), n))
        taken[r] = taken.get(r, 0) + 1
    chosen = sorted(n for _, _, n in sorted(ranked)[:count])
    return torch.tensor([pairs[n] for n in chosen], dtype=torch.int64)


def _starts(recording: Recording, steps: int) -> list[int]:
    """Frames where windows of a recording start: every half window, moved on to where a start is known."""
    frames = torch.nonzero(start_frames(recording)).flatten().tolist()
    last = max(len(recording.position) - 1 - steps, 1)
    begins: list[int] = []
    for wanted in range(1, last + 1, max(steps // 2, 1)):
        begin = next((f for f in frames if f >= wanted), None)
        if begin is not None and begin <= last and begin not in begins:
            begins.append(begin)
    if not begins and frames and frames[0] < len(recording.position) - 1:
        begins = [frames[0]]
    return begins


def _padded(recording: Recording, frames: int) -> Recording:
    """The recording up to `frames` frames: grippers rest where they were, nothing is measured."""
    missing = frames - len(recording.position)
    if missing <= 0:
        return recording

    def still(values: Tensor) -> Tensor:
        return torch.cat((values, values[-1:].expand(missing, *values.shape[1:])))

    unseen = torch.full((missing, *recording.position.shape[1:]), torch.nan)
    g = recording.grips
    return dataclasses.replace(
        recording,
        position=torch.cat((recording.position, unseen)),
        grips=Grip(still(g.position), still(g.rotation), still(g.closed)),
        held=still(recording.held),
    )

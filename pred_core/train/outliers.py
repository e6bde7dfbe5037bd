"""Train recordings that the backbone fails on far more than on the others: damaged, or of another object.

The rule looks at train recordings only, and what it leaves out is printed and stored, never dropped in silence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pred_core.dynamics import Dynamics
from pred_core.errors import DatasetError
from pred_core.train.recordings import Recording, beginnings, gather, window_index


@dataclass(frozen=True)
class LeftOut:
    """One recording that is not trained on, and why."""

    name: str
    error_mm: float  # open-loop mean absolute error per coordinate of the backbone
    median_mm: float  # over all train recordings


def leave_out(base: Dynamics, recordings: Sequence[Recording], factor: float) -> tuple[list[Recording], list[LeftOut]]:
    """Recordings whose backbone error is at most `factor` times the median, and the others. factor 0: all.

    Errors are open loop from the first complete frame, over half the length of the shortest recording.
    Raises: DatasetError if a recording has no complete start.
    """
    if factor == 0.0:
        return list(recordings), []
    error = backbone_error(base, recordings)
    median = float(error.median())
    kept = [r for r, e in zip(recordings, error.tolist(), strict=True) if e <= factor * median]
    out = [
        LeftOut(r.name, e, median) for r, e in zip(recordings, error.tolist(), strict=True) if not e <= factor * median
    ]
    return kept, out


def backbone_error(base: Dynamics, recordings: Sequence[Recording]) -> Tensor:
    """(R,) [mm] open-loop mean absolute error per coordinate of every recording."""
    steps = max(1, min(len(r.position) for r in recordings) // 2)
    index = beginnings(window_index(recordings, steps, 1))
    if len(index) != len(recordings):
        lost = sorted(set(range(len(recordings))) - set(index[:, 0].tolist()))
        raise DatasetError(
            f"{recordings[lost[0]].name}: no start in its first half where every particle is measured",
            next_step="Remove the episode from the train split",
        )
    batch = gather(recordings, index, steps, base.period, torch.device("cpu"))
    with torch.no_grad():
        position = base.rollout(base.start(batch.start, batch.start_grip), batch.grips).cpu()
    difference = (position - batch.target).abs() * batch.seen.unsqueeze(-1)
    return 1e3 * difference.sum(dim=(0, 2, 3)) / (3 * batch.seen.sum(dim=(0, 2))).clamp_min(1)

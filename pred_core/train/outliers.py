"""Train recordings that the backbone fails on far more than on the others: damaged, or of another object.

The rule looks at train recordings only, and what it leaves out is printed and stored, never dropped in silence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pred_core.dynamics import FARTHEST, Dynamics
from pred_core.errors import DatasetError, DivergenceError
from pred_core.train.recordings import Recording, beginnings, gather, window_index
from pred_core.types import Grip, State


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
    """(R,) [mm] open-loop mean absolute error per coordinate of every recording; `FARTHEST` where it diverges."""
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
        state = base.start(batch.start, batch.start_grip)
        try:
            position = base.rollout(state, batch.grips).cpu()
        except DivergenceError:
            position = torch.stack([_alone(base, state, batch.grips, n) for n in range(len(index))], dim=1)
    difference = (position - batch.target).abs() * batch.seen.unsqueeze(-1)
    return 1e3 * difference.sum(dim=(0, 2, 3)) / (3 * batch.seen.sum(dim=(0, 2))).clamp_min(1)


def _alone(base: Dynamics, state: State, grips: Grip, world: int) -> Tensor:
    """Positions (T, N, 3) of one world; all at `FARTHEST` if it diverges, as damaged tracks make a backbone do."""
    one = State(
        state.position[world], state.velocity[world], state.held[world], {k: v[world] for k, v in state.memory.items()}
    )
    alone = Grip(grips.position[:, world], grips.rotation[:, world], grips.closed[:, world])
    try:
        return base.rollout(one, alone).cpu()
    except DivergenceError:
        return torch.full((len(grips.position), *state.position.shape[1:]), FARTHEST)

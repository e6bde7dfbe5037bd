"""Whether a twin predicts at all: its error beside that of assuming that the object stays where it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pred_core.diagnose.judge import Bench
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.weigh import seen_of
from pred_core.errors import DatasetError
from pred_core.identify.space import Candidate
from pred_core.twin import Twin

MOVED = 0.01  # [m] a particle is from where its window began, to be counted; or MOVED_NOISE times the noise
MOVED_NOISE = 5.0
LEAST_MOVED = 0.02  # share of what was seen that must have moved, else nothing can be said
# Shares of the motion in windows of 1.6 s; good twins explain 0.87 to 0.95 of their reference, and 0.6 of episodes in
# which the rope slips out of the jaws.
LEAST = 0.5  # of the reference that a base must explain
POOR = 2.0 / 3.0  # below it nobody can say that nothing is lacking
# From it on, without a reference, what is left may be what engine and object have apart: ropes with nothing hidden are
# explained to 0.94 (5th percentile of 40 seen controls), with a swirl, gusts or a shaking table to 0.77 to 0.94.
WELL = 0.94


@dataclass(frozen=True)
class Skill:
    """Mean distances [m] where the object moved, on held-out episodes."""

    twin: float  # of the prediction from the measurement
    still: float  # of the start of the window from the measurement

    @property
    def share(self) -> float:
        """Of the motion that is explained: 1 is all of it, 0 is no better than no motion."""
        return 1.0 - self.twin / self.still


def skill_of(twin: Twin, roller: Roller, stride: int) -> Skill | None:
    """The twin on the test episodes of a sample, on all if it has none; None if the object hardly moves."""
    sample = roller.sample
    held_out = np.array([s == "test" for s in sample.splits])
    use = torch.as_tensor((held_out if held_out.any() else np.ones_like(held_out))[sample.episode])
    w = sample.windows
    away = (w.target[stride - 1 :: stride] - w.start.position).norm(dim=-1).movedim(0, 1)  # (W, K, N)
    seen = seen_of(roller, stride) & use[:, None, None]
    moved = seen & (away > max(MOVED, MOVED_NOISE * sample.noise))
    if float(moved.sum()) < max(LEAST_MOVED * float(seen.sum()), 1.0):
        return None
    error = Roller(twin, sample).errors([Candidate(twin.physics, twin.extensions)], stride)[0].norm(dim=-1)
    return Skill(float(error[moved].double().mean()), float(away[moved].double().mean()))


def check_reference(bench: Bench) -> None:
    """Raise DatasetError if the twin, refined on the reference, does not describe it: a change against such a base
    means nothing, and weights that allow for its chaos would hide how bad it is.
    """
    if bench.reference is None:
        return
    found = skill_of(bench.reference_twin, bench.reference.roller, bench.config.stride)
    if found is not None and found.share < LEAST:
        raise DatasetError(
            "the twin does not describe the reference, though it was refined on it",
            got=f"{1e3 * found.twin:.0f} mm of error where the object moves by {1e3 * found.still:.0f} mm",
            allowed=f"at most {1.0 - LEAST:.0%} of the motion, in windows of {bench.config.window:g} s",
            next_step="Identify a twin anew from the reference (pred identify), or give a shorter --window",
        )

"""Which tracks are wrong: far from what the model expects, or from what their neighbours say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pred_core.estimate.filter import ErrorFilter, Evidence
from pred_core.types import Array

PASSES = 8  # the worst are taken out first: they make their neighbours look wrong
WORST = 0.5  # of the largest squared distance
MEDIAN = 2.366  # of chi-squared with three degrees of freedom
LEAST_SCALE, MOST_SCALE = 0.25, 30.0  # times the variance of the configuration
SETTLING = 0.5  # [s] over which the scale follows
FEW = 5  # tracks that say nothing of the scale


def believable(errors: ErrorFilter, evidence: Evidence, gate: float) -> NDArray[np.bool_]:
    """(O,) tracks within `gate` standard deviations of the model and of the other believable tracks."""
    limit = gate * gate
    kept = (evidence.innovation**2).sum(axis=1) <= limit * errors.expected(evidence)
    return kept & agreeing(errors, evidence, kept, limit)


def agreeing(
    errors: ErrorFilter, evidence: Evidence, among: NDArray[np.bool_], limit: float
) -> NDArray[np.bool_]:
    """(O,) tracks of `among` that the others of it do not contradict; `limit`: squared standard deviations."""
    kept = among.copy()
    for _ in range(PASSES):
        if not kept.any():
            break
        apart = errors.apart(evidence.only(kept))
        worst = float(apart.max())
        if worst <= limit:
            break
        kept[np.flatnonzero(kept)[apart > max(limit, WORST * worst)]] = False
    return kept


class NoiseScale:
    """How large the tracks' errors are, times the configuration's variance: a running median of what they show."""

    def __init__(self) -> None:
        self.value = 1.0

    def follow(self, apart: Array, seconds: float) -> None:
        """`apart` (O,): squared distances of the tracks of one instant in present units, `seconds` after the last."""
        if len(apart) < FEW:
            return
        share = 1.0 - np.exp(-max(seconds, 0.0) / SETTLING)
        found = self.value * max(float(np.median(apart)) / MEDIAN, 1e-3)
        self.value = float(np.clip(self.value * (found / self.value) ** share, LEAST_SCALE, MOST_SCALE))

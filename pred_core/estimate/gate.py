"""Which tracks are wrong: far from what the model expects, or from what their neighbours say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.filter import ErrorFilter, Evidence
from pred_core.estimate.modes import Modes

PASSES = 8  # the worst are taken out first: they make their neighbours look wrong
WORST = 0.5  # of the largest squared distance
MEDIAN = 2.366  # of chi-squared with three degrees of freedom
LEAST_SCALE, MOST_SCALE = 0.25, 30.0  # times the variance of the configuration
SETTLING = 0.5  # [s] over which the scale follows
FEW = 5  # tracks that say nothing of the scale
SMOOTH = 0.03  # [m] of the model's smooth error, beside which roughness is measured


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
    """How large the tracks' errors are, times the configuration's variance: a running median of how rough they are.

    Errors of the model are smooth, errors of tracks are not: what a track is off a smooth curve through its neighbours
    is its own. Taken against the filter's covariance instead, a model better than expected would look like good tracks.
    """

    def __init__(self, modes: Modes, config: EstimatorConfig):
        """modes: smoother than the model's errors."""
        self.value = 1.0
        self._smooth = ErrorFilter(modes, replace(config, start_position=SMOOTH))

    def follow(self, evidence: Evidence, seconds: float) -> None:
        """Believable tracks of one instant, their variance in present units, `seconds` after the last."""
        if len(evidence.index) < FEW:
            return
        share = 1.0 - np.exp(-max(seconds, 0.0) / SETTLING)
        found = max(float(np.median(self._smooth.apart(evidence))) / MEDIAN, 1e-3)
        self.value = float(np.clip(self.value * found**share, LEAST_SCALE, MOST_SCALE))

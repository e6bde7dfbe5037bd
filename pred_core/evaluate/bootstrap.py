"""Uncertainty of a mean over episodes: episodes are drawn with replacement, never frames."""

from __future__ import annotations

import numpy as np

from pred_core.errors import InputError
from pred_core.types import Array

DRAWS = 10_000


def bootstrap_interval(
    values: Array, generator: np.random.Generator, level: float = 0.95, draws: int = DRAWS
) -> tuple[float, float]:
    """Percentile interval of the mean of `values` (E,), one value an episode.

    Raises: InputError for fewer than two episodes (no spread to draw from) or non-finite values.
    """
    if values.ndim != 1 or len(values) < 2:
        raise InputError("bootstrap: too few episodes", got=values.shape, allowed="two or more")
    if not np.isfinite(values).all():
        raise InputError("bootstrap: a value is not finite")
    means = values[generator.integers(0, len(values), (draws, len(values)))].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)

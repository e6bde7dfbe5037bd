"""From a reference that may only be slow to a set-point that is slow, gentle and smooth.

The reference is averaged over `first` ticks and the result over `second` ticks. Averages are convex combinations:
the set-point never leaves a convex set that holds the reference (workspace box, tilt disc), never exceeds the
reference's speed, and its acceleration and jerk are differences of two averages:
|a| <= 2 v / (first dt), |j| <= 2 a / (second dt). When the reference is frozen the set-point stands still, inside,
after `first + second - 2` ticks, whatever came before.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Smoother:
    """Two moving averages in a row over (6,) coordinates, at rest at `start` in the beginning."""

    def __init__(self, start: Array, first: int, second: int):
        self._raw = np.tile(start, (first, 1))
        self._once = np.tile(start, (second, 1))
        self._ticks = 0

    def step(self, reference: Array) -> Array:
        """The next set-point (6,)."""
        k = self._ticks
        self._raw[k % len(self._raw)] = reference
        self._once[k % len(self._once)] = _mean(self._raw)
        self._ticks += 1
        return _mean(self._once)

    @property
    def at_rest(self) -> bool:
        """The set-point would not move if the reference stayed."""
        return bool((self._raw == self._raw[0]).all() and (self._once == self._once[0]).all())


def _mean(rows: Array) -> Array:
    """Mean around the first row, which is exact when all rows are equal. (K, 6) -> (6,)."""
    return rows[0] + np.add.reduce(rows - rows[0], axis=0) / len(rows)

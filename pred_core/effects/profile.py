"""Smooth profiles over the material coordinate, as Legendre series on 0..1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

TERMS = 12  # coefficients of a profile; leave the high ones at zero for a smoother one


def legendre(coefficients: Sequence[Any], arc: Any) -> Any:
    """sum_k c_k P_k(2 arc - 1), by the three-term recurrence (k+1) P_k+1 = (2k+1) x P_k - k P_k-1."""
    x = 2.0 * arc - 1.0
    before, now = 1.0, x
    total = coefficients[0] + coefficients[1] * x
    for k in range(1, len(coefficients) - 1):
        before, now = now, (2 * k + 1) / (k + 1) * (x * now) - k / (k + 1) * before
        total = total + coefficients[k + 1] * now
    return total

"""Profiles over the material coordinate: straight lines between values at evenly spaced knots.

Local knots, not polynomials: neighbouring values are free of each other, which conditions an identification better
than a series of high order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pred_core.effects.algebra import interpolate

KNOTS = 12  # values of a profile, at arc 0, 1/11, ..., 1


def profile(values: Sequence[Any], arc: Any) -> Any:
    """Linear interpolation of `values` (KNOTS,) at the material coordinate `arc` in 0..1."""
    return interpolate(values, arc)

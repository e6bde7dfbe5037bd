"""A line that resists sharp bends more, or less, than in proportion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import maximum, where
from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.types import Array

MOST, LEAST = 4.0, 0.8  # relative changes of EI it saturates at: beyond, a softening line would snap


class BendingStiffening(Effect):
    """M = EI (1 + a kappa^2) kappa; the relative change x = a kappa^2 saturates as x / (1 + |x| / c).

    c is 4 for a line that stiffens, 0.8 for one that softens, so that EI stays between a fifth and five times its
    value and the moment grows with the curvature.
    """

    id = "bending_stiffening"
    family = "bending"
    hooks = ("bend",)
    parameters = (
        Parameter("gain", "m^2", -1.0, 1.0, typical=0.02, doc="a, relative change of EI at one radian a metre"),
    )
    confounded_with = ("bending_scale", "bending_plasticity")

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        k1, k2 = at.curvature
        change = p["gain"][0] * (k1 * k1 + k2 * k2) / (at.length * at.length)
        size = maximum(change, -change) / where(change > 0.0, MOST, LEAST)
        gain = at.weight * (change / (1.0 + size))
        return gain * k1, gain * k2, ()

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        # Slope of kappa x/(1+x/c) over kappa: c (y/(1+y) + 2 y/(1+y)^2), y = x/c; highest at y = 3. Up to 90 degrees
        # between edges, where the bend's unit is 2.
        sharpest = 2.0 / float(length.min(initial=2.0))
        y = min(max(p["gain"][0], 0.0) * sharpest**2 / MOST, 3.0)
        return MOST * (y / (1.0 + y) + 2.0 * y / (1.0 + y) ** 2), 0.0

"""A line that is stiffer in some places than in others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.effects.profile import TERMS, legendre


class BendingProfile(Effect):
    """M = (EI/l) p(s) k: bending stiffness EI (1 + p(s)), p a Legendre series without a constant term."""

    id = "bending_profile"
    family = "bending"
    hooks = ("bend",)
    parameters = (Parameter("slope", "1", -0.9, 3.0, size=TERMS - 1, doc="Legendre coefficients 1.. of p"),)
    confounded_with = ("mass_profile", "rest_curvature")

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        # A zero of a traced type, so that the law reads the same for tensors.
        gain = at.weight * legendre((at.arc * 0.0, *p["slope"]), at.arc)
        return gain * at.curvature[0], gain * at.curvature[1], ()

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any]) -> tuple[float, float]:
        return abs(float(p["slope"])), 0.0

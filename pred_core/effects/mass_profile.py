"""A line that is heavier in some places than in others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter
from pred_core.effects.profile import TERMS, legendre


class MassProfile(Effect):
    """m(s) -> m(s) (1 + p(s)), p a Legendre series without a constant term: the total stays nearly the same."""

    id = "mass_profile"
    family = "mass"
    hooks = ("inertia",)
    parameters = (Parameter("slope", "1", -0.9, 3.0, size=TERMS - 1, doc="Legendre coefficients 1.. of p"),)
    confounded_with = ("bending_profile",)

    @classmethod
    def inertia(cls, p: Mapping[str, Any], arc: Any) -> Any:
        # A quarter of the mass is the least that keeps a particle a particle.
        return legendre((0.0, *p["slope"]), arc).clamp_min(-0.75)

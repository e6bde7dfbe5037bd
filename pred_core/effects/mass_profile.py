"""A line that is heavier in some places than in others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter
from pred_core.effects.profile import KNOTS, profile


class MassProfile(Effect):
    """m(s) -> m(s) (1 + p(s)), at least a quarter of it: the total mass changes with the mean of p."""

    id = "mass_profile"
    family = "mass"
    hooks = ("inertia",)
    parameters = (Parameter("relative", "1", -0.75, 5.0, size=KNOTS, typical=0.2, doc="p at the knots"),)
    confounded_with = ("bending_profile",)

    @classmethod
    def inertia(cls, p: Mapping[str, Any], arc: Any) -> Any:
        return profile(p["relative"], arc)

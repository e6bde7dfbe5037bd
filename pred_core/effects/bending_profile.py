"""A line that is stiffer in some places than in others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter
from pred_core.effects.profile import KNOTS, profile


class BendingProfile(Effect):
    """EI -> EI (1 + p(s)/2)^2, positive whatever p: elastic moment, damping and hysteresis scale alike."""

    id = "bending_profile"
    family = "bending"
    hooks = ("bend_stiffness",)
    parameters = (Parameter("relative", "1", -1.9, 6.0, size=KNOTS, typical=1.0, doc="p at the knots"),)
    confounded_with = ("mass_profile", "rest_curvature")

    @classmethod
    def bend_stiffness(cls, p: Mapping[str, Any], arc: Any, time: Any) -> Any:
        shape = profile(p["relative"], arc)
        return shape + 0.25 * (shape * shape)

"""Bending stiffness of another size than identified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter


class BendingScale(Effect):
    """EI -> EI (1 + a) everywhere; bending damping and hysteresis scale alike."""

    id = "bending_scale"
    family = "bending"
    hooks = ("bend_stiffness",)
    parameters = (Parameter("change", "1", -0.95, 30.0, typical=0.3, doc="a, relative change"),)
    confounded_with = ("bending_gradient", "bending_region", "stiffness_drift", "rest_curvature")

    @classmethod
    def bend_stiffness(cls, p: Mapping[str, Any], arc: Any, time: Any) -> Any:
        return p["change"][0]

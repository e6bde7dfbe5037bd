"""A line that grows stiffer from one end to the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter


class BendingGradient(Effect):
    """EI -> EI (1 + a (s - 1/2)), s the material coordinate."""

    id = "bending_gradient"
    family = "bending"
    hooks = ("bend_stiffness",)
    parameters = (Parameter("slope", "1", -1.9, 1.9, typical=0.3, doc="a, relative change from end to end"),)
    confounded_with = ("bending_scale", "bending_region", "bending_profile")

    @classmethod
    def bend_stiffness(cls, p: Mapping[str, Any], arc: Any, time: Any) -> Any:
        return p["slope"][0] * (arc - 0.5)

"""A piece that is stiffer or softer than the rest: a splice, a repair, a crack."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import exp
from pred_core.effects.effect import Effect, Parameter


class BendingRegion(Effect):
    """EI -> EI (1 + a exp(-(s - s0)^2 / 2 w^2)), s the material coordinate."""

    id = "bending_region"
    family = "bending"
    hooks = ("bend_stiffness",)
    parameters = (
        Parameter("change", "1", -0.95, 30.0, typical=1.0, doc="a, relative change in the middle of the piece"),
        Parameter("center", "1", 0.0, 1.0, null=0.5, typical=0.1, scan="arc", doc="s0, the middle of the piece"),
        Parameter("width", "1", 0.02, 0.5, null=0.1, typical=0.3, log=True, doc="w, standard deviation of the bell"),
    )
    confounded_with = ("bending_scale", "bending_gradient", "bending_profile")

    @classmethod
    def bend_stiffness(cls, p: Mapping[str, Any], arc: Any, time: Any) -> Any:
        u = (arc - p["center"][0]) / p["width"][0]
        return p["change"][0] * exp(-0.5 * (u * u))

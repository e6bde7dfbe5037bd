"""A line that rests in an arc: it came off a spool."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.types import Array


class RestBow(Effect):
    """M = -(EI/l) l kappa0: the bending moment vanishes at one curvature all along, not at zero.

    The two components of kappa0 are along the material axes, which turn with the gripper. With the edge's length l,
    l kappa0 is the bend's unit 2 tan(angle/2) for angles that are small from one edge to the next.
    """

    id = "rest_bow"
    family = "rest_shape"
    hooks = ("bend", "rest_shape")
    parameters = (
        Parameter("curvature", "1/m", -20.0, 20.0, size=2, typical=1.0, doc="kappa0 along the two material axes"),
    )
    confounded_with = ("rest_curvature", "gripper_rotation", "gravity_offset", "bending_creep")

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        first, second = cls.rest_shape(p, at)
        return -(at.weight * first), -(at.weight * second), ()

    @classmethod
    def rest_shape(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any]:
        return at.length * p["curvature"][0], at.length * p["curvature"][1]

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        k = math.hypot(*p["curvature"]) * float(length.max(initial=0.0))
        return max(0.5 * k, (1.0 + 0.25 * k * k) ** 2 / 8.0 - 1.0), 0.0  # as in `RestCurvature`

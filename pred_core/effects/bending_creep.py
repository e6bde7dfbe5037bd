"""A line that slowly gets used to the shape it is held in."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.types import Array

FORESEEN = 10.0  # [s] of one bend, over which the choice of substeps lets the rest shape follow


class BendingCreep(Effect):
    """M = -(EI/l) k0,  dk0/dt = r (k - k0), implicit in k0: the rest curvature follows the elastic curvature k.

    k0 starts at zero, as if the line were fresh. It is kept per material axis, so the set turns with the gripper.
    """

    id = "bending_creep"
    family = "plastic"
    hooks = ("bend", "rest_shape")
    parameters = (Parameter("rate", "1/s", 0.0, 20.0, typical=0.2, doc="r at which the rest shape follows"),)
    confounded_with = ("bending_plasticity", "bending_hysteresis", "bending_damping", "stiffness_drift")
    bend_memory = 2

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        step = p["rate"][0] * at.substep
        share = step / (1.0 + step)
        k1, k2 = at.curvature[0] - at.rest[0], at.curvature[1] - at.rest[1]
        r1 = at.memory[0] + share * (k1 - at.memory[0])
        r2 = at.memory[1] + share * (k2 - at.memory[1])
        return -(at.weight * r1), -(at.weight * r2), (r1, r2)

    @classmethod
    def rest_shape(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any]:
        return at.memory[0], at.memory[1]

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        # Followed in full at 90 degrees, where k is 2, and bent the other way: as `RestCurvature` with 2.
        return -math.expm1(-FORESEEN * p["rate"][0]), 0.0

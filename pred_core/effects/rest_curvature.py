"""A line that is naturally curved: its relaxed shape is not straight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.effects.profile import KNOTS, profile
from pred_core.types import Array


class RestCurvature(Effect):
    """M = -(EI/l) k0(s): the bending moment vanishes at k0, not at zero.

    k0 has two components in the material frame, each a profile over the arc length. Lengths of cable
    come off a drum curved; the set is fixed in the material and turns with the gripper.
    """

    id = "rest_curvature"
    family = "bending"
    hooks = ("bend", "rest_shape")
    parameters = (
        Parameter("first", "1", -5.0, 5.0, size=KNOTS, typical=0.2, doc="k0 along the first axis, at knots"),
        Parameter("second", "1", -5.0, 5.0, size=KNOTS, typical=0.2, doc="k0 along the second axis, at knots"),
        Parameter(
            "twist", "rad", -4.0, 4.0, typical=0.3, starts=(0.0, -1.57, 1.57, 3.14),
            doc="angle of the material in the last gripper against the first, untwisted"
        ),
    )
    end_twist = "twist"
    confounded_with = ("gravity_offset", "bending_hysteresis")

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        first, second = cls.rest_shape(p, at)
        return -(at.weight * first), -(at.weight * second), ()

    @classmethod
    def rest_shape(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any]:
        return profile(p["first"], at.arc), profile(p["second"], at.arc)

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        # With t = tan(angle/2) and k = |k0|, the energy (EI/2l) |kb - k0|^2 bends like (1+t^2)(1+3t^2 + k t) EI/l
        # in the worst direction: 8 + 2k at 90 degrees; its slope, which turns the edges, is 4 + 2k there. Relative to
        # k = 0 both add k/2 at most. At rest, t = k/2, which may be sharper than 90 degrees, it is (1+t^2)^2.
        k = max(math.hypot(a, b) for a, b in zip(p["first"], p["second"], strict=True))
        return max(0.5 * k, (1.0 + 0.25 * k * k) ** 2 / 8.0 - 1.0), 0.0

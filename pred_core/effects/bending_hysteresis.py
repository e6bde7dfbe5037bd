"""Dry friction inside a cable: strands that slip on each other as it bends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import sqrt
from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.types import Array


class BendingHysteresis(Effect):
    """M = (EI/l) a z,  dz = dk - |dk| z / c (Dahl 1968), per material axis, implicit in z.

    z follows the change of curvature and saturates at c: bent and released, the cable stays a little bent,
    whatever the speed. z starts at zero, as if the cable had relaxed in its first shape.
    """

    id = "bending_hysteresis"
    family = "internal loss"
    hooks = ("bend",)
    parameters = (
        Parameter("ratio", "1", 0.0, 20.0, typical=1.0, starts=(2.0,), doc="a, friction stiffness over EI/l"),
        Parameter(
            "reach", "1", 1e-3, 3.0, null=0.1, typical=0.7, log=True, starts=(0.09,),
            doc="c, curvature (2 tan of half the angle) at which it slips"
        ),
    )
    confounded_with = ("bending_damping", "rest_curvature")
    bend_memory = 2

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        d1, d2 = at.change
        slip = 1.0 + sqrt(d1 * d1 + d2 * d2) / p["reach"][0]
        z1, z2 = (at.memory[0] + d1) / slip, (at.memory[1] + d2) / slip
        gain = at.weight * p["ratio"][0]
        return gain * z1, gain * z2, (z1, z2)

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        return p["ratio"][0], 0.0

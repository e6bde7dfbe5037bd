"""A line that stays bent where it was bent too sharply."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import maximum, sqrt
from pred_core.effects.effect import BendContext, Effect, Parameter


class BendingPlasticity(Effect):
    """M = -(EI/l) k0: the rest curvature k0 flows so that |k - k0| stays within the yield curvature l/R.

    Perfectly plastic: bends wider than the radius R are elastic, sharper ones keep what is beyond. The larger R, the
    sooner it yields. Never stiffer than an elastic bend, so it asks for no substeps of its own.
    """

    id = "bending_plasticity"
    family = "plastic"
    hooks = ("bend", "rest_shape")
    parameters = (
        Parameter("radius", "m", 0.0, 2.0, typical=0.15, starts=(0.1, 0.5), doc="R, sharper bends stay; 0: none does"),
    )
    confounded_with = ("bending_creep", "bending_hysteresis", "rest_bow")
    bend_memory = 2

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        e1 = at.curvature[0] - at.rest[0] - at.memory[0]
        e2 = at.curvature[1] - at.rest[1] - at.memory[1]
        over = maximum(sqrt(e1 * e1 + e2 * e2) * p["radius"][0] / at.length, 1.0)  # elastic over yield curvature
        flow = 1.0 - 1.0 / over
        r1, r2 = at.memory[0] + flow * e1, at.memory[1] + flow * e2
        return -(at.weight * r1), -(at.weight * r2), (r1, r2)

    @classmethod
    def rest_shape(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any]:
        return at.memory[0], at.memory[1]

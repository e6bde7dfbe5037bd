"""A heavier or lighter tip."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import where
from pred_core.effects.effect import Effect, Parameter

BEGIN, END = 0.89, 0.91  # material coordinates between which the tip begins


class TipMass(Effect):
    """m -> m (1 + a) on the last tenth, arc > 0.9; the edge is a smooth step over 0.02."""

    id = "tip_mass"
    family = "mass"
    hooks = ("inertia",)
    parameters = (Parameter("change", "1", -0.9, 20.0, typical=0.5, doc="a, relative change of the tip's mass"),)
    confounded_with = ("mass_gradient", "mass_profile")

    @classmethod
    def inertia(cls, p: Mapping[str, Any], arc: Any) -> Any:
        u = (arc - BEGIN) / (END - BEGIN)
        step = where(u < 0.0, 0.0 * u, where(u > 1.0, 0.0 * u + 1.0, u * u * (3.0 - 2.0 * u)))
        return p["change"][0] * step

"""A heavier or lighter tip."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import where
from pred_core.effects.effect import Effect, Parameter

EDGE = 1.0 / 29.0  # of the ramp in material coordinate: what a particle of a line of 30 stands for


class TipMass(Effect):
    """m -> m (1 + a) on the last tenth, arc > 0.9, whose edge is a ramp as wide as a particle."""

    id = "tip_mass"
    family = "mass"
    hooks = ("inertia",)
    parameters = (Parameter("change", "1", -0.9, 20.0, typical=0.5, doc="a, relative change of the tip's mass"),)
    confounded_with = ("mass_gradient", "mass_profile")

    @classmethod
    def inertia(cls, p: Mapping[str, Any], arc: Any) -> Any:
        ramp = (arc - 0.9) / EDGE + 0.5
        step = where(ramp < 0.0, 0.0 * ramp, where(ramp > 1.0, 0.0 * ramp + 1.0, ramp))
        return p["change"][0] * step

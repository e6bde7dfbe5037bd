"""Air that moves past the object."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.drag_quadratic import FASTEST
from pred_core.effects.effect import Effect, Parameter, ParticleContext


class Wind(Effect):
    """f = m b |w - v| (w - v): quadratic drag in air that moves at the horizontal velocity w; still air is w = 0."""

    id = "wind"
    family = "wind"
    hooks = ("force",)
    parameters = (
        Parameter("coefficient", "1/m", 0.0, 10.0, typical=0.1, doc="b, drag per mass and squared speed"),
        Parameter("velocity", "m/s", -20.0, 20.0, size=2, typical=2.0, scan="direction", doc="w along world x and y"),
    )
    confounded_with = ("drag_quadratic", "gravity_offset", "attraction")

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        past = Vec3(p["velocity"][0], p["velocity"][1], 0.0) - at.velocity
        return past * (p["coefficient"][0] * at.mass * past.norm())

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        return float(p["coefficient"][0]) * (FASTEST + math.hypot(*p["velocity"]))

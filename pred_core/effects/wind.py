"""Air that moves past the object."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.drag_quadratic import FASTEST
from pred_core.effects.effect import Effect, Parameter, ParticleContext


class Wind(Effect):
    """f = m b |u| u: quadratic drag in air that moves at the horizontal velocity w; still air is w = 0.

    u is the part of w - v, the air past a particle, that is across the line, and a share s of what is along it: air
    that flows along a slender body hardly pulls (cross-flow principle; Hoerner, Fluid-Dynamic Drag, 1965, ch. 3). On
    sheets and volumes u = w - v.
    """

    id = "wind"
    version = 2
    family = "wind"
    hooks = ("force",)
    parameters = (
        Parameter("coefficient", "1/m", 0.0, 10.0, typical=0.1, doc="b, drag per mass and squared speed"),
        Parameter("velocity", "m/s", -20.0, 20.0, size=2, typical=2.0, scan="direction", doc="w along world x and y"),
        Parameter("along", "1", 0.0, 1.0, typical=0.5, doc="s, share of the air along a line that pushes"),
    )
    confounded_with = ("drag_quadratic", "gravity_offset", "attraction")
    reads_tangent = True
    headline = "velocity"

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        past = Vec3(p["velocity"][0], p["velocity"][1], 0.0) - at.velocity
        u = past - at.tangent * (past.dot(at.tangent) * (1.0 - p["along"][0]))
        return u * (p["coefficient"][0] * at.mass * u.norm())

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        return float(p["coefficient"][0]) * (FASTEST + math.hypot(*p["velocity"]))

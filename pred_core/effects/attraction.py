"""A place that attracts or repels: a magnet, a charge."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3, exp
from pred_core.effects.effect import Effect, Parameter, ParticleContext


class Attraction(Effect):
    """f = m a (d/r) exp(1/2 - d^2/2r^2) towards a fixed place at the distance d: strongest, m a, at d = r.

    A negative strength repels.
    """

    id = "attraction"
    family = "attraction"
    hooks = ("force",)
    parameters = (
        Parameter("strength", "m/s^2", -20.0, 20.0, typical=0.5, doc="a, the largest acceleration"),
        Parameter("center", "m", -5.0, 5.0, size=3, typical=0.1, scan="place", doc="the place in world"),
        Parameter("range", "m", 0.03, 0.5, null=0.15, typical=0.3, log=True, doc="r, where the force is largest"),
    )
    confounded_with = ("tether", "obstacle", "wind")

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        r = p["range"][0]
        to = Vec3(*p["center"]) - at.position
        return to * (at.mass * p["strength"][0] * exp(0.5 - to.dot(to) / (2.0 * r * r)) / r)

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        # Steepest at the centre, w^2 = a sqrt(e) / r; a rate of w makes up for a frequency of w, see `stability.py`.
        return math.sqrt(abs(p["strength"][0]) * math.sqrt(math.e) / p["range"][0])

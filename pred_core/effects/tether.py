"""A thread from one point of the object to a fixed anchor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3, maximum
from pred_core.effects.effect import Effect, Parameter, ParticleContext

WIDTH = 1.0 / 29.0  # of the hat in material coordinate: the particles of a line of 30
LIGHTEST = 1e-3  # [kg] particles lighter than a quarter of this need more substeps than a thread asks for


class Tether(Effect):
    """f = k max(d - L, 0) towards the anchor at the distance d: slack below its length L.

    It pulls at the particles within WIDTH of its material coordinate, by a hat function.
    """

    id = "tether"
    family = "tether"
    hooks = ("force",)
    parameters = (
        Parameter("stiffness", "N/m", 0.0, 100.0, typical=0.2, doc="k of the thread"),
        Parameter("arc", "1", 0.0, 1.0, null=0.75, typical=0.1, scan="arc", doc="material coordinate it is tied to"),
        Parameter("anchor", "m", -5.0, 5.0, size=3, typical=0.1, scan="place", doc="in world"),
        Parameter("length", "m", 0.0, 3.0, null=0.2, typical=0.1, doc="L, where it becomes taut"),
    )
    confounded_with = ("attraction", "gravity_offset")

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        off = (at.arc - p["arc"][0]) / WIDTH
        share = maximum(1.0 - maximum(off, -off), 0.0)
        to = Vec3(*p["anchor"]) - at.position
        distance = to.norm()
        return to * (p["stiffness"][0] * share * maximum(distance - p["length"][0], 0.0) / distance)

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        # A rate of w makes up for a frequency of w, see `stability.py`.
        return math.sqrt(p["stiffness"][0] / LIGHTEST)

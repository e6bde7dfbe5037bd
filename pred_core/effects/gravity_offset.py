"""Gravity that differs from the declared one, in direction or size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import Effect, Parameter, ParticleContext


class GravityOffset(Effect):
    """f = m dg: a tilted set-up, or a wrong gravity vector in the data set."""

    id = "gravity_offset"
    family = "gravity"
    hooks = ("force",)
    parameters = (Parameter("acceleration", "m/s^2", -5.0, 5.0, size=3, typical=0.2, doc="dg in world"),)
    confounded_with = ("wind", "camera_rotation")

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        return Vec3(*p["acceleration"]) * at.mass

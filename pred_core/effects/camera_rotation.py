"""A camera whose orientation is wrong. Corrected where data enter, not simulated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import Effect, ObserveContext, Parameter


class CameraRotation(Effect):
    """y = c + R (x - c), to second order in the rotation vector w: w x r + w x (w x r) / 2 is added, r = x - c."""

    id = "camera_rotation"
    family = "camera"
    hooks = ("observe",)
    parameters = (
        Parameter("rotation", "rad", -0.5, 0.5, size=3, typical=0.02, doc="rotation vector w in world"),
        Parameter("center", "m", -10.0, 10.0, size=3, typical=1.0, doc="c, the camera's place"),
    )
    confounded_with = ("gravity_offset", "table_tilt", "camera_scale")

    @classmethod
    def observe(cls, p: Mapping[str, Any], at: ObserveContext) -> Vec3:
        w = Vec3(*p["rotation"])
        turned = w.cross(at.position - Vec3(*p["center"]))
        return turned + w.cross(turned) * 0.5

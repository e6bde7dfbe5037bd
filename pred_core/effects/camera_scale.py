"""A camera that sees everything too large or too small. Corrected where data enter, not simulated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import Effect, ObserveContext, Parameter


class CameraScale(Effect):
    """y = c + (1 + a) (x - c): distances between reported points are wrong by the share a."""

    id = "camera_scale"
    family = "camera"
    hooks = ("observe",)
    parameters = (
        Parameter("scale", "1", -0.5, 1.0, typical=0.02, doc="relative error a of distances"),
        Parameter("center", "m", -10.0, 10.0, size=3, typical=1.0, doc="c, the camera's place"),
    )
    confounded_with = ("table_height", "length_scale", "camera_rotation")

    @classmethod
    def observe(cls, p: Mapping[str, Any], at: ObserveContext) -> Vec3:
        return (at.position - Vec3(*p["center"])) * p["scale"][0]

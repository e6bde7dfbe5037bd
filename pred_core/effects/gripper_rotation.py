"""A gripper that is not turned as its pose says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3, sin
from pred_core.effects.effect import Effect, GripContext, Parameter


class GripperRotation(Effect):
    """What is held is turned about the gripper's origin by a rotation vector that is constant in the gripper's frame.

    Rodrigues' formula, with 1 - cos a = 2 sin^2(a/2). It moves the held particles, and so the direction in which the
    object leaves the gripper; the material axes about that direction stay with the reported pose. As for
    `GripperOffset`, only what was not there at the start.
    """

    id = "gripper_rotation"
    family = "gripper_offset"
    hooks = ("boundary",)
    parameters = (
        Parameter("rotation", "rad", -0.8, 0.8, size=3, typical=0.1, doc="rotation vector in the gripper's axes"),
    )
    confounded_with = ("gripper_offset", "camera_rotation", "rest_bow")

    @classmethod
    def boundary(cls, p: Mapping[str, Any], at: GripContext) -> Vec3:
        x, y, z = p["rotation"]
        turn = at.axes[0] * x + at.axes[1] * y + at.axes[2] * z
        angle = turn.norm()
        half = sin(0.5 * angle) / angle
        across = turn.cross(at.lever)
        return across * (sin(angle) / angle) + turn.cross(across) * (2.0 * half * half)

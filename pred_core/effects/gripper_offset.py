"""A gripper that is not where its pose says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import Effect, GripContext, Parameter


class GripperOffset(Effect):
    """What is held sits off its place by a vector that is constant in the gripper's frame: it turns with the gripper.

    `start` measures where in the gripper the held particles sit. An offset that was there then is part of that place
    already; this law adds what that measurement does not contain.
    """

    id = "gripper_offset"
    family = "gripper_offset"
    hooks = ("boundary",)
    parameters = (
        Parameter("offset", "m", -0.1, 0.1, size=3, typical=0.01, doc="along the gripper's x, y and z axes"),
    )
    confounded_with = ("gripper_rotation", "camera_rotation", "grip_slip")

    @classmethod
    def boundary(cls, p: Mapping[str, Any], at: GripContext) -> Vec3:
        x, y, z = p["offset"]
        return at.axes[0] * x + at.axes[1] * y + at.axes[2] * z

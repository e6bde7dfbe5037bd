"""Jaws that hold with a limited force: beyond it the object slides out along them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3, maximum
from pred_core.effects.effect import Effect, GripContext, Parameter, SlideContext


class GripSlip(Effect):
    """m du/dt = F - L sign(u) - c u along the gripper's z axis; the held piece stands still while |F| < L.

    F is the pull on all that the gripper holds, m its mass, u its speed in the jaws; dry friction L and damping c are
    implicit, so that no value needs more substeps. The inertia of the piece in an accelerated gripper is left out.
    """

    id = "grip_slip"
    family = "slip"
    hooks = ("boundary",)
    parameters = (
        Parameter("weakness", "1/N", 0.0, 50.0, typical=2.5, doc="1/L, so that 0 never slips"),
        Parameter("damping", "N s/m", 0.0, 200.0, null=5.0, typical=5.0, doc="c, resistance to sliding beyond L"),
    )
    confounded_with = ("gripper_offset", "length_drift", "bending_creep")
    grip_memory = 2  # how far it has slid [m], and how fast it slides [m/s]

    @classmethod
    def slide(cls, p: Mapping[str, Any], at: SlideContext) -> tuple[Any, ...]:
        way, speed = at.memory
        free = speed + at.pull.dot(at.axes[2]) * at.substep / at.mass
        over = maximum(maximum(free, -free) * at.mass / at.substep * p["weakness"][0], 1.0)  # needed force over L
        slid = free * (1.0 - 1.0 / over) / (1.0 + at.substep * p["damping"][0] / at.mass)
        return way + at.substep * slid, slid

    @classmethod
    def boundary(cls, p: Mapping[str, Any], at: GripContext) -> Vec3:
        return at.axes[2] * at.memory[0]

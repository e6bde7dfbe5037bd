"""Friction that grows with the sliding speed: a film, or felt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import ContactContext, Effect, Parameter
from pred_core.types import Physics


class FrictionViscous(Effect):
    """mu -> mu + c |v|, v along the table: at the load N a force c N v against the motion."""

    id = "friction_viscous"
    family = "friction"
    hooks = ("contact",)
    parameters = (Parameter("coefficient", "s/m", 0.0, 100.0, typical=1.0, doc="c, coefficient added per speed"),)
    confounded_with = ("friction_scale", "drag_linear")
    form = "friction_power"

    @classmethod
    def in_form(cls, p: Mapping[str, tuple[float, ...]], physics: Physics) -> dict[str, tuple[float, ...]]:
        return {"coefficient": p["coefficient"], "power": (1.0,)}

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        return p["coefficient"][0] * Vec3(at.velocity.x, at.velocity.y, 0.0).norm(), 0.0

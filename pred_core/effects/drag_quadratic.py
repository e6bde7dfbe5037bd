"""Quadratic air drag."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import Effect, Parameter, ParticleContext
from pred_core.types import Physics

FASTEST = 5.0  # [m/s] the speed up to which the simulation must stay stable; hands and arms are slower


class DragQuadratic(Effect):
    """f = -m b |v| v: drag of a body in turbulent flow."""

    id = "drag_quadratic"
    family = "drag"
    hooks = ("force",)
    parameters = (Parameter("coefficient", "1/m", 0.0, 50.0, typical=0.5, doc="b, drag per mass and squared speed"),)
    confounded_with = ("drag_linear", "wind")
    form = "drag_power"

    @classmethod
    def in_form(cls, p: Mapping[str, tuple[float, ...]], physics: Physics) -> dict[str, tuple[float, ...]]:
        return {"coefficient": p["coefficient"], "power": (2.0,)}

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        return at.velocity * (-p["coefficient"][0] * at.mass * at.velocity.norm())

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        return float(p["coefficient"][0]) * FASTEST

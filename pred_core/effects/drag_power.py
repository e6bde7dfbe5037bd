"""Air drag that grows with any power of the speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3, exp, log
from pred_core.effects.drag_quadratic import FASTEST
from pred_core.effects.effect import Effect, Parameter, ParticleContext


class DragPower(Effect):
    """f = -m b |v/u|^(p-1) v, u = 1 m/s: linear drag has the power p = 1, quadratic p = 2."""

    id = "drag_power"
    family = "drag"
    hooks = ("force",)
    parameters = (
        Parameter("coefficient", "1/s", 0.0, 50.0, typical=0.5, doc="b, drag per mass and speed at 1 m/s"),
        Parameter("power", "1", 1.0, 3.0, null=1.0, typical=0.5, doc="p of the speed"),
    )
    confounded_with = ("drag_linear", "drag_quadratic", "wind")

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        faster = exp((p["power"][0] - 1.0) * log(at.velocity.norm()))
        return at.velocity * (-p["coefficient"][0] * at.mass * faster)

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        return float(p["coefficient"][0]) * max(1.0, FASTEST ** (float(p["power"][0]) - 1.0))

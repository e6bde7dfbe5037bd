"""Linear air drag."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import Effect, Parameter, ParticleContext
from pred_core.types import Physics


class DragLinear(Effect):
    """f = -m b v: every free particle loses speed at the rate b, whatever its mass."""

    id = "drag_linear"
    family = "drag"
    hooks = ("force",)
    parameters = (Parameter("coefficient", "1/s", 0.0, 50.0, typical=0.5, doc="rate b at which free motion decays"),)
    confounded_with = ("drag_quadratic", "wind")
    form = "drag_power"

    @classmethod
    def in_form(cls, p: Mapping[str, tuple[float, ...]], physics: Physics) -> dict[str, tuple[float, ...]]:
        return {"coefficient": p["coefficient"], "power": (1.0,)}

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        return at.velocity * (-p["coefficient"][0] * at.mass)

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        return float(p["coefficient"][0])

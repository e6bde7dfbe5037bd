"""Friction that grows with any power of the sliding speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3, exp, log
from pred_core.effects.effect import ContactContext, Effect, Parameter


class FrictionPower(Effect):
    """mu -> mu + c (|v|/u)^p, v along the table, u = 1 m/s: p = 0 is another coefficient, p = 1 viscous friction."""

    id = "friction_power"
    family = "friction"
    hooks = ("contact",)
    parameters = (
        Parameter("coefficient", "1", -3.0, 100.0, typical=0.3, doc="c, coefficient added at 1 m/s"),
        Parameter("power", "1", 0.0, 3.0, typical=0.3, doc="p of the speed"),
    )
    confounded_with = ("friction_scale", "friction_viscous")

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        speed = Vec3(at.velocity.x, at.velocity.y, 0.0).norm()
        return p["coefficient"][0] * exp(p["power"][0] * log(speed)), 0.0

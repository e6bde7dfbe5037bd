"""Friction of another size than identified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import ContactContext, Effect, Parameter
from pred_core.types import Physics


class FrictionScale(Effect):
    """mu -> mu (1 + a): another surface, or dust, or moisture."""

    id = "friction_scale"
    family = "friction"
    hooks = ("contact",)
    parameters = (Parameter("change", "1", -1.0, 10.0, typical=0.3, doc="a, relative change of the coefficient"),)
    confounded_with = ("friction_viscous", "friction_anisotropic", "friction_drift", "friction_patch")
    form = "friction_power"

    @classmethod
    def in_form(cls, p: Mapping[str, tuple[float, ...]], physics: Physics) -> dict[str, tuple[float, ...]]:
        """Where particles have coefficients of their own, on average."""
        return {"coefficient": (p["change"][0] * physics.ground_friction,), "power": (0.0,)}

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        return at.friction * p["change"][0], 0.0

"""Friction that depends on the direction of sliding: grain, or a woven cloth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import ContactContext, Effect, Parameter

STANDING = 1e-12  # [m^2/s^2] of squared speed: what stands has no direction


class FrictionAnisotropic(Effect):
    """mu -> mu (1 + a1 cos 2 phi + a2 sin 2 phi), phi the direction of sliding on the table from the world's x.

    With a1 = a cos 2 phi0 and a2 = a sin 2 phi0 it is mu (1 + a cos 2(phi - phi0)): largest along phi0.
    """

    id = "friction_anisotropic"
    family = "friction"
    hooks = ("contact",)
    parameters = (Parameter("components", "1", -2.0, 2.0, size=2, typical=0.3, doc="a cos 2 phi0, a sin 2 phi0"),)
    confounded_with = ("friction_scale", "friction_patch")

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        x, y = at.velocity.x, at.velocity.y
        along, across = p["components"]
        turned = along * (x * x - y * y) + across * (2.0 * x * y)
        return at.friction * turned / (x * x + y * y + STANDING), 0.0

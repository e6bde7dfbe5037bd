"""A place of the table that is stickier, or smoother, than the rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import exp
from pred_core.effects.effect import ContactContext, Effect, Parameter


class FrictionPatch(Effect):
    """mu -> mu (1 + a exp(-d^2 / 2 r^2)), d the distance on the table from the patch's centre."""

    id = "friction_patch"
    family = "patch"
    hooks = ("contact",)
    parameters = (
        Parameter("change", "1", -1.0, 30.0, typical=1.0, doc="a, relative change in the centre"),
        Parameter("center", "m", -5.0, 5.0, size=2, typical=0.1, scan="floor", doc="x and y in world"),
        Parameter("radius", "m", 0.02, 0.5, null=0.08, typical=0.3, log=True, doc="r, standard deviation of the bell"),
    )
    confounded_with = ("friction_scale", "friction_anisotropic", "obstacle")

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        x, y, r = at.position.x - p["center"][0], at.position.y - p["center"][1], p["radius"][0]
        return at.friction * p["change"][0] * exp(-(x * x + y * y) / (2.0 * r * r)), 0.0

"""Axial stiffness of another size than identified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter, SpringContext


class StretchScale(Effect):
    """Tension k (1 + a) e, e the strain.

    Up to a = 3/2 the margin of the substeps chosen for k has room, for `StrainStiffening` besides.
    """

    id = "stretch_scale"
    family = "stretch"
    hooks = ("spring",)
    parameters = (Parameter("change", "1", -0.95, 1.5, typical=0.2, doc="a, relative change of the stiffness"),)
    confounded_with = ("strain_stiffening", "length_scale")

    @classmethod
    def spring(cls, p: Mapping[str, Any], at: SpringContext) -> Any:
        return at.stiffness * p["change"][0] * (at.length / at.rest_length - 1.0)

"""Springs that grow stiffer as they stretch: knit, braid, rubber near its limit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter, SpringContext


class StrainStiffening(Effect):
    """Tension k e (1 + a e^2 / (1 + a e^2)), e the strain: k (1 + a e^2) while it stretches little, 2 k in the end.

    The bound keeps the slope of the tension below 2.125 k, inside the margin of the substeps chosen for k.
    """

    id = "strain_stiffening"
    family = "stretch"
    hooks = ("spring",)
    parameters = (Parameter("growth", "1", 0.0, 1e5, typical=100.0, doc="a, relative growth per squared strain"),)
    confounded_with = ("stretch_scale",)

    @classmethod
    def spring(cls, p: Mapping[str, Any], at: SpringContext) -> Any:
        strain = at.length / at.rest_length - 1.0
        growth = p["growth"][0] * (strain * strain)
        return at.stiffness * strain * (growth / (1.0 + growth))

"""An object that is longer or shorter at rest than it was built."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter, SpringContext


class LengthScale(Effect):
    """Rest length l0 -> l0 (1 + a) at the same stiffness per length: tension k (l/l0 - 1 - a)."""

    id = "length_scale"
    family = "stretch"
    hooks = ("spring",)
    parameters = (Parameter("change", "1", -0.3, 0.3, typical=0.01, doc="a, relative error of the rest length"),)
    confounded_with = ("stretch_scale", "length_drift", "camera_scale")

    @classmethod
    def spring(cls, p: Mapping[str, Any], at: SpringContext) -> Any:
        return -p["change"][0] * at.stiffness

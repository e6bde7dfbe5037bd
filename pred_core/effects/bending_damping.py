"""Viscous loss in bending."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.types import Array


class BendingDamping(Effect):
    """M = (EI/l) tau dk/dt (Kelvin-Voigt): rigid motion costs nothing, changing the shape does."""

    id = "bending_damping"
    family = "internal loss"
    hooks = ("bend",)
    parameters = (Parameter("time", "s", 0.0, 1.0, typical=0.02, doc="tau, bending viscosity over bending stiffness"),)
    confounded_with = ("drag_linear", "bending_hysteresis")

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        gain = at.weight * p["time"][0] / at.substep
        return gain * at.change[0], gain * at.change[1], ()

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        return 0.0, p["time"][0]

"""Tracks that are older than their stamps say. Corrected where data enter (`calibration.yaml`), not simulated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import Effect, ObserveContext, Parameter


class Delay(Effect):
    """y(t) = x(t - d), to first order x - d v: every reported point trails the true one along its path."""

    id = "delay"
    family = "delay"
    hooks = ("observe",)
    parameters = (Parameter("delay", "s", -1.0, 1.0, typical=0.02, doc="d, tracks are older than their stamps"),)
    confounded_with = ("grip_slip", "drag_linear")

    @classmethod
    def observe(cls, p: Mapping[str, Any], at: ObserveContext) -> Vec3:
        return at.velocity * -p["delay"][0]

"""An object that grows longer while one records: it creeps, warms, or takes up moisture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter, SpringContext


class LengthDrift(Effect):
    """Rest length l0 -> l0 (1 + a t): tension k (l/l0 - 1 - a t), t the time of the session as in `FrictionDrift`."""

    id = "length_drift"
    family = "drift"
    hooks = ("spring",)
    parameters = (Parameter("rate", "1/min", -0.2, 0.2, typical=0.01, doc="a, relative change a minute"),)
    confounded_with = ("length_scale", "grip_slip", "bending_creep")

    @classmethod
    def spring(cls, p: Mapping[str, Any], at: SpringContext) -> Any:
        return -p["rate"][0] * at.stiffness * (at.time / 60.0)

"""Friction that changes while one records: wear, dust, moisture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import ContactContext, Effect, Parameter


class FrictionDrift(Effect):
    """mu -> mu (1 + a t), t the simulator's clock; `State.memory["time"]` sets it to the time of the session."""

    id = "friction_drift"
    family = "drift"
    hooks = ("contact",)
    parameters = (Parameter("rate", "1/min", -1.0, 10.0, typical=0.3, doc="a, relative change a minute"),)
    confounded_with = ("friction_scale",)

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        return at.friction * p["rate"][0] * (at.time / 60.0), 0.0

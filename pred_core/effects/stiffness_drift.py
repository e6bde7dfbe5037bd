"""A line that grows stiffer or softer while it is worked with: warmed, wetted, worn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import maximum, minimum
from pred_core.effects.effect import Effect, Parameter

LEAST, MOST = -0.95, 9.0  # of the relative change: a line keeps a twentieth of its stiffness and gains tenfold at most


class StiffnessDrift(Effect):
    """EI -> EI (1 + r t), t the time of the session; held at a twentieth and at ten times of EI."""

    id = "stiffness_drift"
    family = "drift"
    hooks = ("bend_stiffness",)
    parameters = (Parameter("rate", "1/min", -3.0, 3.0, typical=0.3, doc="r, relative growth of EI"),)
    confounded_with = ("bending_scale", "bending_creep", "length_drift")

    @classmethod
    def bend_stiffness(cls, p: Mapping[str, Any], arc: Any, time: Any) -> Any:
        return minimum(maximum(p["rate"][0] * (time / 60.0), LEAST), MOST)

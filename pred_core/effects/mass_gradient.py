"""A body that grows heavier from one end to the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import Effect, Parameter


class MassGradient(Effect):
    """m -> m (1 + a (s - 1/2)), s the material coordinate: the whole stays as heavy."""

    id = "mass_gradient"
    family = "mass"
    hooks = ("inertia",)
    parameters = (Parameter("slope", "1", -1.9, 1.9, typical=0.3, doc="a, relative change from end to end"),)
    confounded_with = ("tip_mass", "mass_profile")

    @classmethod
    def inertia(cls, p: Mapping[str, Any], arc: Any) -> Any:
        return p["slope"][0] * (arc - 0.5)

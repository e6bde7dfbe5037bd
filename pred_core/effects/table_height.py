"""A table that stands higher or lower than declared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import ContactContext, Effect, Parameter


class TableHeight(Effect):
    """The plane z = ground + h."""

    id = "table_height"
    family = "table"
    hooks = ("contact",)
    parameters = (Parameter("height", "m", -0.1, 0.1, typical=0.005, doc="h, added to the declared height"),)
    confounded_with = ("table_tilt", "obstacle", "camera_scale")

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        return 0.0, p["height"][0]

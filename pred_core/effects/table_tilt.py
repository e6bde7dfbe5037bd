"""A table that is higher on one side, under gravity that is right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.effect import ContactContext, Effect, Parameter


class TableTilt(Effect):
    """The plane z = ground + sx x + sy y. The table still pushes along z: a slope of less than about a tenth."""

    id = "table_tilt"
    family = "table"
    hooks = ("contact",)
    parameters = (Parameter("slope", "1", -0.2, 0.2, size=2, typical=0.01, doc="sx and sy in world"),)
    confounded_with = ("table_height", "gravity_offset", "camera_rotation")

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        return 0.0, p["slope"][0] * at.position.x + p["slope"][1] * at.position.y

"""The library of causes. Adding one is one file and one line in `LIBRARY`."""

from __future__ import annotations

from pred_core.effects.bending_damping import BendingDamping
from pred_core.effects.bending_hysteresis import BendingHysteresis
from pred_core.effects.bending_profile import BendingProfile
from pred_core.effects.drag_linear import DragLinear
from pred_core.effects.drag_quadratic import DragQuadratic
from pred_core.effects.effect import Effect
from pred_core.effects.gravity_offset import GravityOffset
from pred_core.effects.mass_profile import MassProfile
from pred_core.effects.rest_curvature import RestCurvature
from pred_core.errors import TwinError, nearest

_ALL: tuple[type[Effect], ...] = (
    DragLinear,
    DragQuadratic,
    GravityOffset,
    BendingDamping,
    BendingHysteresis,
    RestCurvature,
    BendingProfile,
    MassProfile,
)
LIBRARY: dict[str, type[Effect]] = {e.id: e for e in _ALL}


def find_effect(id: str) -> type[Effect]:
    """The effect with this id. Raises: TwinError with the nearest known id."""
    if id not in LIBRARY:
        raise TwinError(f"unknown effect '{id}'", next_step=nearest(id, LIBRARY))
    return LIBRARY[id]

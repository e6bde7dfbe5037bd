"""The library of causes. Adding one is one file `ID.py` with its `Effect` here, and its id as one line in `IDS`."""

from __future__ import annotations

import importlib

from pred_core.effects.effect import Effect
from pred_core.errors import TwinError, nearest
from pred_core.twin import Extension

# In this order they are listed and tried.
IDS = (
    "drag_linear",
    "drag_quadratic",
    "drag_power",
    "gravity_offset",
    "bending_damping",
    "bending_hysteresis",
    "rest_curvature",
    "bending_profile",
    "mass_profile",
    "wind",
    "attraction",
    "tether",
    "obstacle",
    "friction_scale",
    "friction_viscous",
    "friction_power",
    "friction_anisotropic",
    "friction_patch",
    "table_height",
    "tip_mass",
    "mass_gradient",
    "bending_scale",
    "bending_region",
    "friction_drift",
    "table_tilt",
    "bending_gradient",
    "strain_stiffening",
    "stretch_scale",
    "length_drift",
    "length_scale",
    "stiffness_drift",
    "bending_creep",
    "rest_bow",
    "bending_stiffening",
    "bending_plasticity",
    "gripper_offset",
    "gripper_rotation",
    "grip_slip",
    "delay",
    "camera_scale",
    "camera_rotation",
)


def _load(id: str) -> type[Effect]:
    """The effect that the module of this name defines."""
    module = importlib.import_module(f"{__name__}.{id}")
    (effect,) = (v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__
                 and issubclass(v, Effect))  # fmt: skip
    assert effect.id == id, f"{module.__name__} defines '{effect.id}'"
    return effect


LIBRARY: dict[str, type[Effect]] = {id: _load(id) for id in IDS}


def find_effect(id: str) -> type[Effect]:
    """The effect with this id. Raises: TwinError with the nearest known id."""
    if id not in LIBRARY:
        raise TwinError(f"unknown effect '{id}'", next_step=nearest(id, LIBRARY))
    return LIBRARY[id]


def effect_of(extension: Extension) -> type[Effect]:
    """The effect of an entry of a twin, whose values fit it. Raises: TwinError naming the file the entry is from."""
    if extension.id not in LIBRARY:
        where = f"{extension.source}: " if extension.source else ""
        raise TwinError(f"{where}unknown effect '{extension.id}'", next_step=nearest(extension.id, LIBRARY))
    effect = LIBRARY[extension.id]
    effect.check(extension)
    return effect


def confounded(id: str) -> tuple[str, ...]:
    """Ids of the effects that are often mistaken for this one: those it names, then those that name it."""
    own = find_effect(id).confounded_with
    return (*own, *(e.id for e in LIBRARY.values() if id in e.confounded_with and e.id not in own))

"""The library of causes. Adding one is one file and one line in `LIBRARY`."""

from __future__ import annotations

from pred_core.effects.attraction import Attraction
from pred_core.effects.bending_creep import BendingCreep
from pred_core.effects.bending_damping import BendingDamping
from pred_core.effects.bending_gradient import BendingGradient
from pred_core.effects.bending_hysteresis import BendingHysteresis
from pred_core.effects.bending_plasticity import BendingPlasticity
from pred_core.effects.bending_profile import BendingProfile
from pred_core.effects.bending_region import BendingRegion
from pred_core.effects.bending_scale import BendingScale
from pred_core.effects.bending_stiffening import BendingStiffening
from pred_core.effects.camera_rotation import CameraRotation
from pred_core.effects.camera_scale import CameraScale
from pred_core.effects.delay import Delay
from pred_core.effects.drag_linear import DragLinear
from pred_core.effects.drag_quadratic import DragQuadratic
from pred_core.effects.effect import Effect
from pred_core.effects.friction_anisotropic import FrictionAnisotropic
from pred_core.effects.friction_drift import FrictionDrift
from pred_core.effects.friction_patch import FrictionPatch
from pred_core.effects.friction_scale import FrictionScale
from pred_core.effects.friction_viscous import FrictionViscous
from pred_core.effects.gravity_offset import GravityOffset
from pred_core.effects.grip_slip import GripSlip
from pred_core.effects.gripper_offset import GripperOffset
from pred_core.effects.gripper_rotation import GripperRotation
from pred_core.effects.length_drift import LengthDrift
from pred_core.effects.length_scale import LengthScale
from pred_core.effects.mass_gradient import MassGradient
from pred_core.effects.mass_profile import MassProfile
from pred_core.effects.obstacle import Obstacle
from pred_core.effects.rest_bow import RestBow
from pred_core.effects.rest_curvature import RestCurvature
from pred_core.effects.stiffness_drift import StiffnessDrift
from pred_core.effects.strain_stiffening import StrainStiffening
from pred_core.effects.stretch_scale import StretchScale
from pred_core.effects.table_height import TableHeight
from pred_core.effects.table_tilt import TableTilt
from pred_core.effects.tether import Tether
from pred_core.effects.tip_mass import TipMass
from pred_core.effects.wind import Wind
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
    Wind,
    Attraction,
    Tether,
    Obstacle,
    FrictionScale,
    FrictionViscous,
    FrictionAnisotropic,
    FrictionPatch,
    TableHeight,
    TipMass,
    MassGradient,
    BendingScale,
    BendingRegion,
    FrictionDrift,
    TableTilt,
    BendingGradient,
    StrainStiffening,
    StretchScale,
    LengthDrift,
    LengthScale,
    StiffnessDrift,
    BendingCreep,
    RestBow,
    BendingStiffening,
    BendingPlasticity,
    GripperOffset,
    GripperRotation,
    GripSlip,
    Delay,
    CameraScale,
    CameraRotation,
)
LIBRARY: dict[str, type[Effect]] = {e.id: e for e in _ALL}


def find_effect(id: str) -> type[Effect]:
    """The effect with this id. Raises: TwinError with the nearest known id."""
    if id not in LIBRARY:
        raise TwinError(f"unknown effect '{id}'", next_step=nearest(id, LIBRARY))
    return LIBRARY[id]

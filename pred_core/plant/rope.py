"""The rope as MuJoCo sees it: capsules on ball joints with rotational springs, clamped in a gripper."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.types import STANDARD_GRAVITY

Array = NDArray[np.float64]
Index = NDArray[np.int64]

GROUND = "table"
GRIPPER = "gripper"
STEP = 1.0 / 300.0  # [s]
# MuJoCo takes the larger coefficient of a pair. Everything but the rope has none, so that the rope's counts, and an
# effect changes friction link by link.
NO_FRICTION = (1e-5, 1e-5, 1e-5)
# Dry friction in a joint. With MuJoCo's usual compliance a joint that should stick creeps by 1 cm/s under the rope.
FIRM_REF = [2.0 * STEP, 1.0]
FIRM = [0.9999, 0.9999, 0.001, 0.5, 2.0]
SLIDE_ARMATURE = 1e4  # [kg] so heavy that the rope's pull, about 1 N, moves the gripper by less than 0.1 um
TURN_ARMATURE = 1e2  # [kg m^2]


@dataclass(frozen=True)
class RopeConfig:
    """A rope of its own stiffness in MuJoCo's terms."""

    length: float = setting(0.7, unit="m", low=0.05, high=5.0, doc="from end to end")
    mass: float = setting(0.05, unit="kg", low=1e-4, high=10.0, doc="of the whole rope")
    links: int = setting(32, low=4, high=200, doc="capsules")
    clamped: int = setting(1, low=1, high=8, doc="links in the jaws; the first two tracked points sit in them")
    radius: float = setting(0.004, unit="m", low=5e-4, high=0.05, doc="of the capsules")
    bending: float = setting(3e-4, unit="N m^2", low=1e-6, high=1.0, doc="EI: a joint's spring is EI / link length")
    damping: float = setting(0.02, unit="s", low=0.0, high=1.0, doc="a joint's damper over its spring")
    armature: float = setting(1e-6, unit="kg m^2", low=0.0, high=1e-2, doc="of a joint")
    friction: float = setting(0.6, low=0.0, high=3.0, doc="Coulomb coefficient of the rope on everything")

    @property
    def link_length(self) -> float:
        """Length of a capsule's axis [m]."""
        return self.length / self.links


@dataclass
class RopeModel:
    """A MuJoCo model before it is compiled, and where the rope is in it. Links count from the gripper."""

    spec: mujoco.MjSpec
    rope: RopeConfig
    reversed: bool  # grasped at the other end
    links: list[mujoco.MjsBody]  # from the gripper outwards
    joints: list[mujoco.MjsJoint | None]  # the ball joint a link hangs on; None for clamped links

    @property
    def material(self) -> Array:
        """Material coordinate (links,) in 0..1 of each link's middle; it stays with the rope when it is regrasped."""
        s = (np.arange(self.rope.links) + 0.5) / self.rope.links
        return 1.0 - s if self.reversed else s

    @property
    def joint_material(self) -> Array:
        """Material coordinate (links,) of the joint each link hangs on."""
        s = np.arange(self.rope.links) / self.rope.links
        return 1.0 - s if self.reversed else s

    @property
    def ground(self) -> mujoco.MjsGeom:
        """The table plane."""
        return self.spec.geom(GROUND)


def build_rope(rope: RopeConfig, *, reversed: bool = False, gripper: bool = True) -> RopeModel:
    """The rope over the table plane z = 0, straight along -z of its gripper, which stands at the world origin.

    gripper: three slides (x, y, z) and three hinges (yaw, pitch, roll) of high armature carry it, as degrees of freedom
    0 to 5 (`drive.py` moves them). Without one, the rope is free in space and no link is clamped.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # the pyramid has up to 41 % more friction along diagonals
    spec.option.gravity = list(STANDARD_GRAVITY)
    # Twice the step is the stiffest contact MuJoCo allows; its usual 0.02 s lets a free end sink by 4 mm.
    spec.default.geom.solref = [2.0 * STEP, 1.0]
    spec.default.geom.solimp = [0.95, 0.99, 0.001, 0.5, 2.0]
    spec.worldbody.add_geom(
        name=GROUND, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3.0, 3.0, 0.1], friction=list(NO_FRICTION)
    )
    parent = spec.worldbody
    if gripper:
        parent = _add_gripper(spec)
    links: list[mujoco.MjsBody] = []
    joints: list[mujoco.MjsJoint | None] = []
    for i in range(rope.links):
        link = parent.add_body(name=f"link{i}", pos=[0.0, 0.0, 0.0 if i == 0 else -rope.link_length])
        link.add_geom(
            name=f"link{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0.0, 0.0, 0.0, 0.0, 0.0, -rope.link_length],
            size=[rope.radius, 0.0, 0.0],
            mass=rope.mass / rope.links,
            friction=[rope.friction, 0.005, 0.0001],
        )
        joints.append(_add_joint(link, rope, i, gripper))
        links.append(link)
        parent = link
    return RopeModel(spec, rope, reversed, links, joints)


def _add_gripper(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    body = spec.worldbody.add_body(name=GRIPPER, gravcomp=1.0, mass=0.1, inertia=[1e-4] * 3, explicitinertial=True)
    for name, axis in (("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1])):
        body.add_joint(name=f"slide_{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, armature=SLIDE_ARMATURE)
    for name, axis in (("yaw", [0, 0, 1]), ("pitch", [0, 1, 0]), ("roll", [1, 0, 0])):
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, armature=TURN_ARMATURE)
    return body


def _add_joint(link: mujoco.MjsBody, rope: RopeConfig, i: int, gripper: bool) -> mujoco.MjsJoint | None:
    if not gripper and i == 0:
        link.add_freejoint()
        return None
    if gripper and i < rope.clamped:
        return None
    stiffness = rope.bending / rope.link_length
    return link.add_joint(
        name=f"ball{i}",
        type=mujoco.mjtJoint.mjJNT_BALL,
        stiffness=stiffness,
        damping=rope.damping * stiffness,
        armature=rope.armature,
    )

"""An xArm7-class arm in MuJoCo: the chain's bodies, position servos with velocity feed-forward, compensated gravity."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.plant.live.chain import (
    COUNT,
    LIMITS,
    OFFSETS,
    READY,
    ROLLS,
    TOOL_LENGTH,
    Chain,
)
from pred_core.plant.live.mover import HAND, STEEL, TOOL, Segment, ToolPose, add_hand

Array = NDArray[np.float64]
NAMES = tuple(f"joint{k + 1}" for k in range(COUNT))
MASS = (2.5, 1.9, 1.7, 1.8, 1.4, 1.4, 1.0)  # [kg] of the links, the last with gripper
RADIUS = (0.055, 0.055, 0.05, 0.05, 0.045, 0.045, 0.04)  # [m]
ARMATURE = 0.1  # [kg m^2] of motors and gears
STIFFNESS, DAMPING = 1500.0, 150.0  # servo [N m / rad], [N m s / rad]
EFFORT = (50.0, 50.0, 30.0, 30.0, 30.0, 20.0, 20.0)  # [N m]
WHITE = (0.92, 0.92, 0.9, 1.0)


class Arm7:
    """Position servos: torque = STIFFNESS (q_ref - q) + DAMPING (v_ref - v), the second term fed forward."""

    def __init__(self, origin: Array, yaw: float = 0.0):
        self.chain = Chain(origin, yaw)
        self._origin, self._yaw = np.array(origin, float), yaw
        self._qpos = self._dof = np.zeros(COUNT, np.int64)
        self._controls = np.zeros(COUNT, np.int64)
        self._begin: Array = READY.copy()
        self._end: Array = READY.copy()
        self._seconds = 1.0

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add base, links, servos and hand."""
        spec.compiler.degree = False
        base = spec.worldbody.add_body(
            name="base", pos=self._origin.tolist(), quat=[np.cos(0.5 * self._yaw), 0.0, 0.0, np.sin(0.5 * self._yaw)]
        )
        _limb(base, "base", OFFSETS[0], 0.07, 4.0)
        parent = base
        for k, name in enumerate(NAMES):
            turned = [np.cos(0.5 * ROLLS[k]), np.sin(0.5 * ROLLS[k]), 0.0, 0.0]
            parent = parent.add_body(name=f"arm{k + 1}", pos=OFFSETS[k].tolist(), quat=turned, gravcomp=1.0)
            parent.add_joint(
                name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, 0.0, 1.0], armature=ARMATURE,
                limited=mujoco.mjtLimited.mjLIMITED_TRUE, range=LIMITS[k].tolist(),
            )  # fmt: skip
            way = OFFSETS[k + 1] if k + 1 < COUNT else np.array([0.0, 0.0, 0.04])
            _limb(parent, f"limb{k + 1}", way, RADIUS[k], MASS[k])
            _add_servo(spec, name, EFFORT[k])
        tool = parent.add_body(name=TOOL, pos=[0.0, 0.0, TOOL_LENGTH], gravcomp=1.0)
        add_hand(tool)

    def bind(self, model: mujoco.MjModel) -> None:
        """Find joints and servos."""
        found = [model.joint(name) for name in NAMES]
        self._qpos = np.array([int(j.qposadr[0]) for j in found])
        self._dof = np.array([int(j.dofadr[0]) for j in found])
        self._controls = np.array([model.actuator(name).id for name in NAMES])

    def place(self, data: mujoco.MjData, pose: ToolPose) -> None:
        """Stand still at a pose."""
        self._begin = self._end = self.chain.inverse(pose, READY, posture_steps=60)
        data.qpos[self._qpos] = self._end
        data.qvel[self._dof] = 0.0

    def aim(self, segment: Segment) -> None:
        """Solve for the end of the segment; in between the joints move evenly.

        A segment that stays is not solved for: at the edge of the reach the same pose may not be found twice.
        """
        end = self._end if segment.stays else self.chain.inverse(segment.end, self._end)
        self._begin, self._end, self._seconds = self._end, end, segment.seconds

    def push(self, data: mujoco.MjData, share: float) -> None:
        """Servo inputs; the feed-forward moves them ahead by DAMPING / STIFFNESS = 0.1 s of the reference's speed."""
        rate = (self._end - self._begin) / self._seconds
        reference = (1.0 - share) * self._begin + share * self._end
        data.ctrl[self._controls] = reference + (DAMPING / STIFFNESS) * rate

    def joints(self, data: mujoco.MjData) -> dict[str, float]:
        """Measured angles [rad]."""
        return dict(zip(NAMES, data.qpos[self._qpos].tolist(), strict=True))


def _limb(body: mujoco.MjsBody, name: str, way: Array, radius: float, mass: float) -> None:
    """A capsule along the way to the next joint, or a ball where the next joint is at the same place."""
    length = float(np.linalg.norm(way))
    common = dict(name=name, mass=mass, contype=HAND, conaffinity=0, rgba=list(WHITE if radius > 0.045 else STEEL))
    if length < 0.01:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0.0, 0.0], **common)
        return
    ends = [0.0, 0.0, 0.0, *way.tolist()]
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[radius, 0.0, 0.0], **common)


def _add_servo(spec: mujoco.MjSpec, joint: str, effort: float) -> None:
    servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.gainprm[0] = STIFFNESS
    servo.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    servo.biasprm[1], servo.biasprm[2] = -STIFFNESS, -DAMPING
    servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    servo.forcerange = [-effort, effort]

"""A gripper without an arm: six heavy joints with feed-forward, which follow their reference whatever they carry."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.plant.drive import BANDWIDTH
from pred_core.plant.live.mover import DOWN, TOOL, Segment, ToolPose, add_hand, matrix_of, multiply
from pred_core.plant.rope import SLIDE_ARMATURE, TURN_ARMATURE

Array = NDArray[np.float64]
JOINTS = ("slide_x", "slide_y", "slide_z", "yaw", "pitch", "roll")
_ARMATURE = np.array([SLIDE_ARMATURE] * 3 + [TURN_ARMATURE] * 3)
_UP_FROM_DOWN = DOWN * np.array([1.0, -1.0, -1.0, -1.0])


class FreeGripper:
    """Slides along x, y, z, then turns about z, y, x; the tool hangs below with its z axis down."""

    def __init__(self) -> None:
        self._dof: NDArray[np.int64] = np.zeros(6, np.int64)
        self._qpos: NDArray[np.int64] = np.zeros(6, np.int64)
        self._begin: Array = np.zeros(6)
        self._end: Array = np.zeros(6)
        self._seconds = 1.0

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add carriage and tool."""
        body = spec.worldbody.add_body(name="carriage", mass=0.1, inertia=[1e-4] * 3, explicitinertial=True)
        body.gravcomp = 1.0
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        for name, axis in zip(JOINTS[:3], np.eye(3).tolist(), strict=True):
            body.add_joint(name=name, type=slide, axis=axis, armature=SLIDE_ARMATURE)
        for name, axis in zip(JOINTS[3:], np.eye(3)[::-1].tolist(), strict=True):
            body.add_joint(name=name, type=hinge, axis=axis, armature=TURN_ARMATURE)
        add_hand(body.add_body(name=TOOL, quat=DOWN.tolist(), gravcomp=1.0))

    def bind(self, model: mujoco.MjModel) -> None:
        """Find the joints."""
        found = [model.joint(name) for name in JOINTS]
        self._dof = np.array([int(j.dofadr[0]) for j in found])
        self._qpos = np.array([int(j.qposadr[0]) for j in found])

    def place(self, data: mujoco.MjData, pose: ToolPose) -> None:
        """Stand still at a pose."""
        self._begin = self._end = _coordinates(pose, np.zeros(6))
        data.qpos[self._qpos] = self._end
        data.qvel[self._dof] = 0.0

    def aim(self, segment: Segment) -> None:
        """Linear in the joint coordinates: at 30 steps a second, as good as slerp."""
        begin = self._end
        self._begin, self._end = begin, _coordinates(segment.end, begin)
        self._seconds = segment.seconds

    def push(self, data: mujoco.MjData, share: float) -> None:
        """Critically damped feedback on position and speed of the reference."""
        rate = (self._end - self._begin) / self._seconds
        target = (1.0 - share) * self._begin + share * self._end
        off, slow = target - data.qpos[self._qpos], rate - data.qvel[self._dof]
        data.qfrc_applied[self._dof] = _ARMATURE * (2.0 * BANDWIDTH * slow + BANDWIDTH**2 * off)

    def joints(self, data: mujoco.MjData) -> dict[str, float]:
        """None: there is no arm."""
        return {}


def _coordinates(pose: ToolPose, near: Array) -> Array:
    """(6,) x, y, z, yaw, pitch, roll of the carriage; the angles nearest to those of `near`."""
    m = matrix_of(multiply(pose.rotation, _UP_FROM_DOWN))
    yaw, pitch, roll = np.arctan2(m[1, 0], m[0, 0]), -np.arcsin(np.clip(m[2, 0], -1, 1)), np.arctan2(m[2, 1], m[2, 2])
    angles = np.array([yaw, pitch, roll])
    angles += 2.0 * np.pi * np.round((near[3:] - angles) / (2.0 * np.pi))
    return np.concatenate([pose.position, angles])

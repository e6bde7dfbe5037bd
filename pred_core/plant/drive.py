"""The gripper drive: PD with feed-forward on six heavy joints, so that it follows its reference whatever it carries.

The rope is never a child of a mocap body: MuJoCo teleports those, and their children feel no inertia.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.plant.motion import Path
from pred_core.plant.rope import SLIDE_ARMATURE, TURN_ARMATURE

Array = NDArray[np.float64]
DOF = 6  # x, y, z, yaw, pitch, roll: the first coordinates of the model
BANDWIDTH = 60.0  # [rad/s]
_ARMATURE = np.array([SLIDE_ARMATURE] * 3 + [TURN_ARMATURE] * 3)


class Drive:
    """Follows a `Path`, one reference a step."""

    def __init__(self, path: Path):
        self.path = path

    def place(self, data: mujoco.MjData) -> None:
        """Put the gripper on the first reference, with its speed."""
        data.qpos[:DOF] = self.path.position[0]
        data.qvel[:DOF] = self.path.velocity[0]

    def push(self, data: mujoco.MjData, step: int) -> None:
        """Set the drive's forces of a step: acceleration of the reference plus critically damped feedback."""
        p = self.path
        wanted = (
            p.acceleration[step]
            + 2.0 * BANDWIDTH * (p.velocity[step] - data.qvel[:DOF])
            + BANDWIDTH**2 * (p.position[step] - data.qpos[:DOF])
        )
        data.qfrc_applied[:DOF] = _ARMATURE * wanted


def poses(coordinates: Array) -> tuple[Array, Array]:
    """Position (T, 3) [m] and rotation (T, 4) wxyz, world_from_gripper, of drive coordinates (T, 6)."""
    yaw, pitch, roll = (0.5 * coordinates[:, k] for k in (3, 4, 5))
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    rotation = np.stack(
        (
            cz * cy * cx + sz * sy * sx,
            cz * cy * sx - sz * sy * cx,
            cz * sy * cx + sz * cy * sx,
            sz * cy * cx - cz * sy * sx,
        ),
        axis=-1,
    )
    return coordinates[:, :3].copy(), rotation

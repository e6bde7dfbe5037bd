"""How a line object lies when an episode begins: hanging straight, or slanting to the table and flat on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pred_core.plant.motion import Motion

Array = NDArray[np.float64]
STEEP = 0.5  # [rad] a gripper pitched less than this holds a hanging object


def laid_angles(motion: Motion, count: int, length: float, clamped: int, clearance: float) -> Array:
    """Angle (count,) [rad] of each piece of `length` [m] from straight down towards -x of the gripper.

    The clamped pieces keep the gripper's pitch; a piece that would come nearer to the table than `clearance` lies flat.
    """
    pitch, height = float(motion.home[4]), float(motion.home[2])
    angles = np.full(count, pitch)
    for i in range(count):
        if i:
            angles[i] = angles[i - 1]
        if i >= clamped and pitch > STEEP and height - length * np.cos(angles[i]) < 2.0 * clearance:
            angles[i] = 0.5 * np.pi
        height -= length * np.cos(angles[i])
    return angles

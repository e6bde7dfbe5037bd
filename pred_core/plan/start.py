"""What a robot may be moved from: grippers about where they may be, with what they hold in them."""

from __future__ import annotations

import numpy as np

from pred_core.errors import InputError
from pred_core.plan.config import MotionConfig
from pred_core.plan.latency import Observation

OUTSIDE = 0.1  # [m] a gripper may be out of its workspace, from which a plan leads back; runs of the loop: below 1 mm
REACH = 0.15  # [m] from a gripper to the nearest particle it holds; runs of the loop: below 2 mm, and 26 to the second


def check_start(seen: Observation, motion: MotionConfig) -> None:
    """Raise InputError for a gripper clearly out of its workspace, or far from all that it is said to hold."""
    low = np.array([motion.x_low, motion.y_low, motion.z_low])
    high = np.array([motion.x_high, motion.y_high, motion.z_high])
    points, held = seen.state.position.double().cpu().numpy(), seen.state.held.cpu().numpy()
    for gripper, place in enumerate(seen.position):
        off = float(np.linalg.norm(np.maximum(np.maximum(low - place, place - high), 0.0)))
        if off > OUTSIDE:
            raise InputError(
                f"gripper {gripper} is outside its workspace", got=f"{off:.2f} m", allowed=f"{OUTSIDE:g} m",
                next_step="Check gripper/pose, or widen the workspace in the planner's settings",
            )  # fmt: skip
        mine = points[held == gripper]
        far = float(np.linalg.norm(mine - place, axis=1).min()) if len(mine) else 0.0
        if far > REACH:
            raise InputError(
                f"gripper {gripper} is far from what it is said to hold", got=f"{far:.2f} m", allowed=f"{REACH:g} m",
                next_step="Check gripper/pose, and 'held' of the predictor",
            )  # fmt: skip

"""The joints of an xArm7-class arm: forward kinematics, Jacobian, damped-least-squares inverse kinematics.

Offsets as UFACTORY publishes them: 0.267, 0.293, 0.0525, 0.0775/0.3425, 0.076/0.097 m, and 0.172 m to the tool centre.
Every joint turns about the z axis of its own frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import InputError
from pred_core.plant.live.mover import ToolPose, quaternion_of_matrix, rotation_between

Array = NDArray[np.float64]
COUNT = 7
TOOL_LENGTH = 0.172  # [m] flange to tool centre
# Per joint: offset [m] and roll [rad] about x from the frame before to its own.
OFFSETS = np.array(
    [
        [0.0, 0.0, 0.267],
        [0.0, 0.0, 0.0],
        [0.0, -0.293, 0.0],
        [0.0525, 0.0, 0.0],
        [0.0775, -0.3425, 0.0],
        [0.0, 0.0, 0.0],
        [0.076, 0.097, 0.0],
    ]
)
ROLLS = 0.5 * np.pi * np.array([0.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
LIMITS = np.array(
    [
        [-2 * np.pi, 2 * np.pi],
        [-2.059, 2.0944],
        [-2 * np.pi, 2 * np.pi],
        [-0.19198, 3.927],
        [-2 * np.pi, 2 * np.pi],
        [-1.69297, np.pi],
        [-2 * np.pi, 2 * np.pi],
    ]
)  # [rad]
READY = np.array([0.0, -0.247, 0.0, 0.909, 0.0, 1.15644, 0.0])  # elbow up, tool down
DAMPING = 0.02  # of the least squares [m], [rad]
POSTURE = 0.05  # share of the way back to READY a step takes in the null space
ITERATIONS = 40
CLOSE = 1e-6  # [m], [rad] where the iteration ends
REACHED = 1e-3  # [m], [rad] a larger rest means out of reach
LONGEST_STEP = 0.2  # [rad] of a joint in one iteration


def _turn_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


_ROLLED = np.array([_turn_x(a) for a in ROLLS])


class Chain:
    """The kinematics of one arm whose base stands at `origin` (3,) [m] world, turned by `yaw` [rad]."""

    def __init__(self, origin: Array, yaw: float):
        self._origin = np.array(origin, float)
        c, s = np.cos(yaw), np.sin(yaw)
        self._base = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def forward(self, q: Array) -> tuple[ToolPose, Array]:
        """Tool pose and Jacobian (6, 7): rows velocity [m/s], then angular velocity [rad/s], of the tool in world."""
        turned, place = self._base, self._origin
        axes, places = np.empty((COUNT, 3)), np.empty((COUNT, 3))
        spin = np.zeros((COUNT, 3, 3))  # about each joint's own z axis
        spin[:, 0, 0] = spin[:, 1, 1] = np.cos(q)
        spin[:, 1, 0] = np.sin(q)
        spin[:, 0, 1], spin[:, 2, 2] = -spin[:, 1, 0], 1.0
        spin = _ROLLED @ spin
        for k in range(COUNT):
            place = place + turned @ OFFSETS[k]
            turned = turned @ spin[k]
            axes[k], places[k] = turned[:, 2], place
        tip = place + TOOL_LENGTH * turned[:, 2]
        arm = tip - places
        linear = axes[:, [1, 2, 0]] * arm[:, [2, 0, 1]] - axes[:, [2, 0, 1]] * arm[:, [1, 2, 0]]  # axis x arm
        return ToolPose(tip, quaternion_of_matrix(turned)), np.concatenate([linear.T, axes.T])

    def inverse(self, target: ToolPose, near: Array, posture_steps: int = 1) -> Array:
        """Joint angles (7,) [rad] that reach `target`, starting from `near`.

        Damped least squares (Nakamura and Hanafusa 1986); in the null space the arm is drawn to READY for
        `posture_steps` iterations. Raises: InputError if the target is out of reach.
        """
        q = np.clip(near, LIMITS[:, 0], LIMITS[:, 1])
        error = np.full(6, np.inf)
        for iteration in range(posture_steps + ITERATIONS):
            pose, jacobian = self.forward(q)
            error = np.concatenate([target.position - pose.position, rotation_between(pose.rotation, target.rotation)])
            if iteration >= posture_steps and np.abs(error).max() < CLOSE:
                return q
            gram = jacobian @ jacobian.T
            # Damping fades with the error, so that the last steps are Newton's.
            damping = DAMPING**2 * min(1.0, float(np.abs(error).max()) / 0.05)
            back = np.linalg.solve(gram + (damping + 1e-9) * np.eye(6), np.column_stack([error, jacobian]))
            rest = POSTURE * (READY - q) if iteration < posture_steps else np.zeros(COUNT)
            step = jacobian.T @ back[:, 0] + rest - jacobian.T @ (back[:, 1:] @ rest)
            step *= min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
            q = np.clip(q + step, LIMITS[:, 0], LIMITS[:, 1])
        if np.abs(error).max() > REACHED:
            raise InputError(
                "plant: pose out of the arm's reach",
                got=f"{target.position.round(3).tolist()} m, off by {np.abs(error).max():.3g}",
                next_step="Command a pose nearer to the base, or a smaller tilt",
            )
        return q

"""The adapters' own limit: an arm that obeys any set-point is never given one it would have to race for."""

from __future__ import annotations

import numpy as np

from pred_core.arm.orientation import Quaternion, angle_between
from pred_core.arm.protocol import Array, SetPoint
from pred_core.errors import InputError

MARGIN = 1.05  # above the guard's own limits, which hold exactly


class StepCheck:
    """Refuses a set-point farther from the one before than `speed` [m/s], `angular_speed` [rad/s] x `period` [s]."""

    def __init__(self, period: float, speed: float, angular_speed: float):
        self._most = MARGIN * period * speed
        self._most_angle = MARGIN * period * angular_speed
        self._place: Array | None = None
        self._turned: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def restart(self, position: Array, rotation: Quaternion) -> None:
        """Begin at the measured pose, or at the pose sent last."""
        self._place, self._turned = np.array(position, float), rotation

    def forget(self) -> None:
        """Allow nothing until `restart`."""
        self._place = None

    def check(self, setpoint: SetPoint, name: str) -> None:
        """Raises: InputError for a step that is too long, not finite, or before `restart`."""
        if self._place is None:
            raise InputError(f"{name}: a set-point before the arm was enabled")
        off = float(np.linalg.norm(setpoint.position - self._place))
        angle = angle_between(self._turned, setpoint.rotation)
        if not (off <= self._most and angle <= self._most_angle):
            raise InputError(
                f"{name}: set-point too far from the one before",
                got=f"{1e3 * off:.2f} mm, {angle:.4f} rad",
                allowed=f"{1e3 * self._most:.2f} mm, {self._most_angle:.4f} rad",
            )
        self.restart(setpoint.position, setpoint.rotation)

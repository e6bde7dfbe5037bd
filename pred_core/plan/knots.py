"""The samples of the search as motions within limits.

A sample is the free velocity knots (M, G, 4) of a curve: all but the two that the start fixes and the two of rest.
`KnotLimits.apply` bends any sample into one that keeps its limits; it never fails, so every sample can be rolled out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pred_core.errors import ConfigError
from pred_core.plan.config import MotionConfig
from pred_core.types import Array


@dataclass(frozen=True)
class Beginning:
    """Where a plan begins: the pose, velocity and acceleration the grippers will have then."""

    position: Array  # (G, 3) [m] world
    rotation: Array  # (G, 4) wxyz
    velocity: Array  # (G, 4) [m/s], [rad/s] of yaw
    acceleration: Array  # (G, 4) [m/s^2], [rad/s^2]


class KnotLimits:
    """Speed, acceleration and the workspace box, made to hold knot by knot.

    Speed holds exactly. Acceleration holds exactly inside the box; at its wall, and where the beginning itself is
    faster than the limits, a gripper stops within one knot. A gripper that begins outside the box may stay outside,
    but goes no farther.
    """

    def __init__(self, config: MotionConfig):
        """Raises: ConfigError for an empty box."""
        self.segments = config.knots
        self.spacing = config.horizon / config.knots
        self.low = np.array([config.x_low, config.y_low, config.z_low])
        self.high = np.array([config.x_high, config.y_high, config.z_high])
        if not (self.low < self.high).all():
            got = f"{self.low.tolist()} to {self.high.tolist()} m"
            raise ConfigError("the planner's workspace box is empty", got=got, allowed="low below high")
        self._most, self._change = self._bounds(config.speed, config.acceleration)
        self._most_turn, self._change_turn = self._bounds(config.turn_speed, config.turn_acceleration)
        # Whether the change can be too large for knots within their speeds; always where the beginning is fixed.
        both = ((self._most, self._change), (self._most_turn, self._change_turn))
        self._bound = [i == 0 or any(c[i] < m[i - 1] + m[i] for m, c in both) for i in range(self.free)]

    @property
    def free(self) -> int:
        """Number of knots M a sample chooses."""
        return self.segments - 2

    def _bounds(self, fast: float, acceleration: float) -> tuple[list[float], list[float]]:
        """Largest norm of each of M free knots, and of its change; the brake at the end takes half the acceleration."""
        brake = 0.5 * acceleration * self.spacing
        most = [min(fast, brake * left) for left in range(self.free, 0, -1)]
        return most, [brake if m < fast else 2.0 * brake for m in most]

    def apply(self, samples: Array, first: Array, start: Array) -> Array:
        """All knots (S + 2, K, G, 4) of samples (M, K, G, 4).

        first: (2, G, 4) the knots the beginning fixes; start: (G, 3) [m] where it is.
        """
        count, grippers = samples.shape[1:3]
        h = self.spacing
        # Axes come first inside, so that every operation runs over one row of all samples.
        knots = np.zeros((self.segments + 2, 4, count, grippers))
        knots[:2] = first.transpose(0, 2, 1)[:, :, None]
        knots[2:-2] = samples.transpose(0, 3, 1, 2)
        # The positions c around which the curve runs (curve.py); c_1 is fixed by the beginning.
        begin = start + h * (first[1, :, :3] - (first[1, :, :3] - first[0, :, :3]) / 6.0)
        low = np.minimum(self.low, begin).T[:, None]
        high = np.maximum(self.high, begin).T[:, None]
        place = np.broadcast_to(begin.T[:, None], (3, count, grippers))
        for i in range(self.free):
            now, before = knots[i + 2], knots[i + 1]
            if self._bound[i]:
                now -= before
                _shorten(now, self._change[i], self._change_turn[i])
                now += before
            _shorten(now, self._most[i], self._most_turn[i])
            after = place + h * now[:3]
            np.minimum(np.maximum(after, low, out=after), high, out=after)
            np.multiply(after - place, 1.0 / h, out=now[:3])
            place = after
        return np.ascontiguousarray(knots.transpose(0, 2, 3, 1))


def _shorten(rows: Array, length: float, turn: float) -> None:
    """Shorten velocities, rows x, y, z, yaw of (4, ...), to at most `length` and `turn`, in place."""
    square = rows[:3] * rows[:3]
    square[0] += square[1]
    square[0] += square[2]
    rows[:3] *= length / np.sqrt(np.maximum(square[0], length * length))
    np.minimum(np.maximum(rows[3], -turn, out=rows[3]), turn, out=rows[3])

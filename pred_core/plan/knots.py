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
            raise ConfigError("the planner's workspace box is empty",
                              got=f"{self.low.tolist()} to {self.high.tolist()} m", allowed="low below high")  # fmt: skip
        self._ways = (
            (slice(0, 3), *self._bounds(config.speed, config.acceleration)),
            (slice(3, 4), *self._bounds(config.turn_speed, config.turn_acceleration)),
        )

    @property
    def free(self) -> int:
        """Number of knots M a sample chooses."""
        return self.segments - 2

    def _bounds(self, fast: float, acceleration: float) -> tuple[Array, Array]:
        """(M,) largest norm of each free knot, and of its change; the brake at the end takes half the acceleration."""
        brake = 0.5 * acceleration * self.spacing
        most = np.minimum(fast, brake * np.arange(self.free, 0, -1))
        return most, np.where(most < fast, brake, 2.0 * brake)

    def apply(self, samples: Array, first: Array, start: Array) -> Array:
        """All knots (S + 2, K, G, 4) of samples (M, K, G, 4).

        first: (2, G, 4) the knots the beginning fixes; start: (G, 3) [m] where it is.
        """
        count, grippers = samples.shape[1], samples.shape[2]
        knots = np.zeros((self.segments + 2, count, grippers, samples.shape[3]))
        knots[:2] = first[:, None]
        knots[2:-2] = samples
        h = self.spacing
        # The positions c around which the curve runs (curve.py); c_1 is fixed by the beginning.
        place = np.broadcast_to(
            start + h * (first[1, :, :3] - (first[1, :, :3] - first[0, :, :3]) / 6.0), (count, grippers, 3)
        )
        low, high = np.minimum(self.low, place), np.maximum(self.high, place)
        for i in range(self.free):
            now, before = knots[i + 2], knots[i + 1]
            for axes, most, change in self._ways:
                part = now[..., axes]
                step = _within(part - before[..., axes], change[i])
                part[...] = _within(before[..., axes] + step, most[i])
            after = np.clip(place + h * now[..., :3], low, high)
            now[..., :3] = (after - place) / h
            place = after
        return knots


def _within(vectors: Array, length: float) -> Array:
    """Vectors (..., A) shortened to at most `length`."""
    square = np.einsum("...i,...i->...", vectors, vectors)[..., None]
    return vectors * np.minimum(1.0, length / np.sqrt(np.maximum(square, 1e-30)))

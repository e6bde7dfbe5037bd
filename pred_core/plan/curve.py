"""A smooth gripper motion: position and yaw as a cubic B-spline whose velocity is given by knots.

Segment k of length h runs over the velocity knots k, k+1, k+2, so that the first two knots hold the velocity v0 and
acceleration a0 the motion begins with, and two last knots of zero end it at rest:

    u_0 = v0 - a0 h / 2,   u_1 = v0 + a0 h / 2,   c_0 = p0 - (h / 6) (u_1 - u_0),   c_j = c_{j-1} + h u_j

with the positions c around which the curve runs. Speeds lie in the convex hull of the knots, accelerations are
differences of neighbours over h, positions lie in the hull of the c: limits on knots are limits on the motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.types import Array

AXES = 4  # x, y, z, yaw


@dataclass(frozen=True)
class Curve:
    """The motion of G grippers. Yaw turns the first rotation about world z; the tilt stays."""

    spacing: float  # h [s]
    start: Array  # (G, 3) [m] world, position at time 0
    rotation: Array  # (G, 4) wxyz world_from_gripper at time 0
    knots: Array  # (S + 2, G, 4) velocity knots [m/s], [rad/s]

    @property
    def segments(self) -> int:
        """Number of segments S."""
        return len(self.knots) - 2

    @property
    def seconds(self) -> float:
        """Length [s]; the grippers rest afterwards if the last two knots are zero."""
        return self.segments * self.spacing

    def displacement(self, times: Array) -> Array:
        """(T, G, 4) way [m] and yaw [rad] gone since time 0, at times (T,) [s] clipped to the motion."""
        return np.tensordot(self._weights(times, 0), self.knots, axes=1)

    def velocity(self, times: Array) -> Array:
        """(T, G, 4) [m/s], [rad/s] at times (T,) [s], clipped to the motion."""
        return np.tensordot(self._weights(times, 1), self.knots, axes=1)

    def acceleration(self, times: Array) -> Array:
        """(T, G, 4) [m/s^2], [rad/s^2] at times (T,) [s], clipped to the motion."""
        return np.tensordot(self._weights(times, 2), self.knots, axes=1)

    def poses(self, times: Array) -> tuple[Array, Array]:
        """Positions (T, G, 3) [m] world and rotations (T, G, 4) wxyz at times (T,) [s]."""
        gone = self.displacement(times)
        return self.start + gone[..., :3], turned(self.rotation, gone[..., 3])

    def stopping(self, seconds: float) -> Curve:
        """The same motion up to `seconds` [s] (rounded up to a knot), then a stop within two segments."""
        keep = int(np.ceil(seconds / self.spacing - 1e-9)) + 2
        if keep + 2 > len(self.knots):
            return self
        knots = self.knots[: keep + 2].copy()
        knots[keep:] = 0.0
        return Curve(self.spacing, self.start, self.rotation, knots)

    def _weights(self, times: Array, order: int) -> Array:
        clipped = np.clip(np.asarray(times, float), 0.0, self.seconds)
        return _rows(clipped, self.segments, self.spacing, order)


def resting(position: Array, rotation: Array, spacing: float) -> Curve:
    """Grippers that stay at (G, 3) [m], (G, 4) wxyz."""
    return Curve(spacing, position, rotation, np.zeros((4, len(position), AXES)))


def first_knots(velocity: Array, acceleration: Array, spacing: float) -> Array:
    """The two knots (2, G, 4) that begin with a velocity (G, 4) and an acceleration (G, 4)."""
    half = 0.5 * spacing * acceleration
    return np.stack((velocity - half, velocity + half))


def turned(rotation: NDArray[Any], yaw: NDArray[Any]) -> NDArray[Any]:
    """Rotations (..., 4) wxyz turned about world z by yaw (...) [rad]; leading axes broadcast."""
    half = 0.5 * np.asarray(yaw)
    c, s = np.cos(half), np.sin(half)
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    out = np.empty(np.broadcast_shapes(half.shape, w.shape) + (4,), c.dtype)
    out[..., 0], out[..., 1] = c * w - s * z, c * x - s * y
    out[..., 2], out[..., 3] = c * y + s * x, c * z + s * w
    return out


def displacement_weights(times: Array, segments: int, spacing: float) -> Array:
    """(T, S + 2) matrix from velocity knots to the way gone at times (T,) [s] within the motion."""
    return _rows(np.asarray(times, float), segments, spacing, 0)


def _rows(times: Array, segments: int, spacing: float, order: int) -> Array:
    """Rows (T, S + 2) that give displacement (order 0), velocity (1) or acceleration (2) from the knots."""
    k = np.clip((times / spacing).astype(int), 0, segments - 1)
    s = times / spacing - k
    rows = np.zeros((len(times), segments + 2))
    if order == 0:
        # The integral of the quadratic basis from 0 to t: whole segments before k, then the part of k.
        whole = np.array([1.0, 4.0, 1.0]) / 6.0
        for j in range(segments):
            rows[j < k, j : j + 3] += spacing * whole
        part = np.stack((1 - (1 - s) ** 3, 3 * s + 3 * s**2 - 2 * s**3, s**3), axis=-1) * (spacing / 6.0)
    elif order == 1:
        part = np.stack(((1 - s) ** 2, 1 + 2 * s - 2 * s**2, s**2), axis=-1) * 0.5
    else:
        part = np.stack((s - 1, 1 - 2 * s, s), axis=-1) / spacing
    place = k[:, None] + np.arange(3)
    np.add.at(rows, (np.arange(len(times))[:, None], place), part)
    return rows

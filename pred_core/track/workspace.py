"""Where the object can be: a box over the table, minus fixtures and the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.errors import ConfigError
from pred_core.types import Array, Capsule, Fixture, Sphere

Shape = Fixture
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Workspace:
    """The box in world that is looked at, and the table plane in it."""

    low: tuple[float, float, float] = setting((-0.6, -0.6, 0.0), unit="m", doc="lowest corner")
    high: tuple[float, float, float] = setting((0.6, 0.6, 1.0), unit="m", doc="highest corner")
    table: float = setting(0.0, unit="m", low=-10.0, high=10.0, doc="height of the table's top")
    clearance: float = setting(0.002, unit="m", low=0.0, high=0.1, doc="what is lower above the table is the table")
    depth_noise: float = setting(0.004, unit="1/m", low=0.0, high=0.1, doc="depth errors over depth squared")

    def contains(self, points: Array) -> Flags:
        """(M,) of points (M, 3) [m] world inside the box. Its floor is the table, which masks take care of."""
        low = np.array([self.low[0], self.low[1], min(self.low[2], self.table) - 0.02])
        return np.asarray(((points >= low) & (points <= np.array(self.high))).all(axis=-1))


def check_workspace(workspace: Workspace) -> None:
    """Raise ConfigError if the box is empty or lies under the table."""
    low, high = np.array(workspace.low), np.array(workspace.high)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all() and high[2] > workspace.table):
        raise ConfigError(
            "workspace box", got=f"low {workspace.low}, high {workspace.high}", allowed="low < high, above the table"
        )


def inside_any(points: Array, shapes: Sequence[Shape], margin: float) -> Flags:
    """(M,) of points (M, 3) [m] world within `margin` [m] of any shape."""
    found = np.zeros(len(points), bool)
    for shape in shapes:
        found |= _distance(points, shape) < margin
    return found


def _distance(points: Array, shape: Shape) -> Array:
    """Distance (M,) [m] to a shape's surface, zero or negative inside."""
    if isinstance(shape, Sphere):
        return np.asarray(np.linalg.norm(points - np.array(shape.center), axis=-1)) - shape.radius
    if isinstance(shape, Capsule):
        start, along = np.array(shape.start), np.subtract(shape.end, shape.start)
        share = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=-1)) - shape.radius
    w, x, y, z = shape.rotation
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    beyond = np.abs((points - np.array(shape.center)) @ rotation) - np.array(shape.half_size)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return np.asarray(outside + np.minimum(beyond.max(axis=-1), 0.0))

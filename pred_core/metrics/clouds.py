"""What the point-cloud metrics accept."""

from __future__ import annotations

import numpy as np

from pred_core.errors import InputError
from pred_core.types import Array


def checked_cloud(points: Array, name: str) -> Array:
    """`points` (P, 3) [m] unchanged. Raises: InputError if it is empty, of another shape or not finite."""
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"{name}: not a point cloud", got=f"shape {points.shape}", allowed="(P, 3) with P > 0")
    if not np.isfinite(points).all():
        raise InputError(
            f"{name}: {int((~np.isfinite(points).all(-1)).sum())} of {len(points)} points are not finite",
            next_step="Leave hidden particles out before measuring the distance",
        )
    return points

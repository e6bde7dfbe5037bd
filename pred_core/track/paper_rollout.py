"""The paper's own pipeline (Appendix A), as the baseline: 2D tracks, lifted velocities, k nearest neighbours, rollout.

2D motion comes from any `PixelMotion`; without learned weights that is pyramidal Lucas-Kanade. Velocities of the cloud
at one frame carry the particles to the next, x(t+1) = x(t) + v(t) dt; nothing is anchored, so errors add up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pred_core.track.flow import Gray, depth_at, follow_pixels, gray_of
from pred_core.track.view import View, pixel_rays
from pred_core.types import Array, CameraFrame

NEIGHBOURS = 5  # k of the paper
GRID = 1500  # pixels followed in each camera


class PixelMotion(Protocol):
    """Where pixels of one picture are in the next."""

    def __call__(self, before: Gray, after: Gray, pixel: Array, guess: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (M, 2) in `after`, and whether they were found."""


class PaperRollout:
    """Particles carried by the mean velocity of their neighbours in the observed cloud."""

    def __init__(self, position: Array, motion: PixelMotion = follow_pixels):
        """From particles (P, 3) [m] world."""
        self.position = position.copy()
        self._motion = motion
        self._before: dict[str, tuple[Gray, CameraFrame, NDArray[np.int64]]] = {}

    def step(self, frames: Mapping[str, CameraFrame], views: Sequence[View]) -> Array:
        """Carry the particles to new pictures; `views` hold the object's pixels in them. Returns (P, 3) [m]."""
        points, shifts = [], []
        for view in views:
            frame = frames[view.camera]
            gray = gray_of(frame.rgb)
            if view.camera in self._before:
                start, shift = self._lifted(*self._before[view.camera], gray, frame)
                points.append(start)
                shifts.append(shift)
            step = max(1, len(view.pixel) // GRID)
            self._before[view.camera] = (gray, frame, view.pixel[::step])
        if points and sum(len(p) for p in points) >= NEIGHBOURS:
            near = cKDTree(np.concatenate(points)).query(self.position, k=NEIGHBOURS)[1]
            self.position = self.position + np.concatenate(shifts)[near].mean(axis=1)
        return self.position

    def _lifted(
        self, before: Gray, old: CameraFrame, pixel: NDArray[np.int64], after: Gray, new: CameraFrame
    ) -> tuple[Array, Array]:
        """Points (M, 3) [m] of the older picture and how far they have moved (M, 3) [m]."""
        v, u = np.divmod(pixel, old.depth.shape[1])
        start = np.stack([u, v], axis=-1).astype(np.float64)
        end, found = self._motion(before, after, start, start)
        first, last = _lift(old, start), _lift(new, end)
        known = found & np.isfinite(first).all(axis=-1) & np.isfinite(last).all(axis=-1)
        return first[known], (last - first)[known]


def _lift(frame: CameraFrame, pixel: Array) -> Array:
    depth = depth_at(frame.depth, pixel)
    return pixel_rays(frame, pixel[:, 0], pixel[:, 1]) * depth[:, None] + frame.world_from_camera[:3, 3]

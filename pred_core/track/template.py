"""First-seen patches: what a particle looked like when it was first seen undoes the drift of frame-to-frame flow.

The patch is compared with the picture now, warped by how the particle's neighbourhood has moved since, and shifted by
Gauss-Newton (Lucas & Kanade 1981, translation only) until it fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.track.flow import Gray, opencv
from pred_core.types import Array

SIDE = 15  # [px] of a patch
ITERATIONS = 4
LEAST_TEXTURE = 2.0  # smaller eigenvalue of the mean gradient matrix, grey levels squared: 0.1 px at noise of 2 levels
FARTHEST = 5.0  # [px] a patch may be shifted
LEAST_CORRELATION = 0.85

_SPAN = np.arange(SIDE) - SIDE // 2
_GRID = np.stack(np.meshgrid(_SPAN, _SPAN, indexing="xy"), axis=-1).reshape(-1, 2).astype(np.float64)  # (S, 2)


@dataclass
class Templates:
    """First-seen patches of one camera's particles."""

    seen: NDArray[np.bool_]  # (P,)
    patch: NDArray[np.float32]  # (P, S)
    pixel: Array  # (P, 2) where it was
    neighbours: Array  # (P, 2, 2) two tangents [px per m of rest length] then
    offset: Array  # (P, 3) [m] from the particle to the surface this camera sees, in the particle's rest frame

    @staticmethod
    def empty(count: int) -> Templates:
        """None seen yet."""
        return Templates(
            np.zeros(count, bool),
            np.zeros((count, SIDE * SIDE), np.float32),
            np.zeros((count, 2)),
            np.tile(np.eye(2), (count, 1, 1)),
            np.zeros((count, 3)),
        )

    def keep(self, gray: Gray, new: NDArray[np.int64], pixel: Array, frame: Array, offset: Array) -> None:
        """Remember the patches of particles `new` (M,); of all, pixel (P, 2), tangents (P, 2, 2), offset (P, 3) now."""
        if len(new):
            self.offset[new] = offset[new]
            self.patch[new] = sample(gray, pixel[new], np.tile(np.eye(2), (len(new), 1, 1)))
            self.pixel[new], self.neighbours[new] = pixel[new], frame[new]
            self.seen[new] = True

    def match(self, gray: Gray, index: NDArray[np.int64], pixel: Array, frame: Array) -> tuple[Array, Array]:
        """Corrected pixels (M, 2) of particles `index` (M,) near `pixel` (M, 2), and correlations (M,), 0 if no match.

        `frame` (M, 2, 2): the tangents now; with those of then they give the affine warp of the patch.
        """
        warp = frame @ np.linalg.pinv(self.neighbours[index])
        template = self.patch[index]
        gx, gy = _gradients(template)
        hessian = np.stack(
            [
                np.stack([(gx * gx).mean(-1), (gx * gy).mean(-1)], -1),
                np.stack([(gx * gy).mean(-1), (gy * gy).mean(-1)], -1),
            ],
            axis=-2,
        )
        textured = np.linalg.eigvalsh(hessian)[:, 0] > LEAST_TEXTURE
        inverse = np.linalg.inv(hessian + 1e-3 * np.eye(2))
        shift, now = np.zeros((len(index), 2)), template
        for _ in range(ITERATIONS):
            now = sample(gray, pixel + np.einsum("mab,mb->ma", warp, shift), warp)
            error = _normal(template) - _normal(now)
            scale = template.std(-1)
            rhs = np.stack([(gx * error).mean(-1), (gy * error).mean(-1)], -1) * scale[:, None]
            shift = shift + np.einsum("mab,mb->ma", inverse, rhs)
        now = sample(gray, pixel + np.einsum("mab,mb->ma", warp, shift), warp)
        correlation = (_normal(template) * _normal(now)).mean(-1)
        moved = np.einsum("mab,mb->ma", warp, shift)
        good = textured & (correlation > LEAST_CORRELATION) & (np.linalg.norm(moved, axis=-1) < FARTHEST)
        return np.where(good[:, None], pixel + moved, pixel), np.where(good, correlation, 0.0)


def sample(gray: Gray, pixel: Array, warp: Array) -> NDArray[np.float32]:
    """Patches (M, S) around pixels (M, 2) with warps (M, 2, 2) from patch to picture."""
    cv2 = opencv()
    at = pixel[:, None] + np.einsum("mab,sb->msa", warp, _GRID)
    maps = at.astype(np.float32)
    return np.asarray(cv2.remap(gray, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR), np.float32)


def _gradients(patch: NDArray[np.float32]) -> tuple[Array, Array]:
    square = patch.reshape(-1, SIDE, SIDE).astype(np.float64)
    gx, gy = (np.asarray(np.gradient(square, axis=a)) for a in (2, 1))
    return gx.reshape(len(patch), -1), gy.reshape(len(patch), -1)


def _normal(patch: NDArray[np.float32]) -> Array:
    centred = patch - patch.mean(-1, keepdims=True)
    return np.asarray(centred / np.maximum(centred.std(-1, keepdims=True), 1e-3), np.float64)

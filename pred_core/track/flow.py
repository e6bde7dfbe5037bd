"""Motion of pixels between two pictures: pyramidal Lucas-Kanade, checked forward and backward."""

from __future__ import annotations

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import ConfigError
from pred_core.types import Array

Gray = NDArray[np.uint8]
WINDOW = (15, 15)  # [px]
LEVELS = 3


def opencv() -> ModuleType:
    """OpenCV. Raises: ConfigError if it is not installed."""
    try:
        import cv2
    except ImportError as error:
        raise ConfigError("optical flow needs OpenCV", next_step="pip install 'opencv-python-headless<5'") from error
    return cv2  # type: ignore[no-any-return]


def gray_of(rgb: NDArray[np.uint8]) -> Gray:
    """(H, W) of (H, W, 3)."""
    cv2 = opencv()
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


def follow_pixels(
    before: Gray, after: Gray, pixel: Array, guess: Array, largest: float = 1.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Where pixels (M, 2) of `before` are in `after`, from a guess (M, 2), and whether they come back within `largest`
    [px] when followed backwards."""
    if not len(pixel):
        return guess.copy(), np.zeros(0, bool)
    cv2 = opencv()
    settings = dict(winSize=WINDOW, maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    start, first = pixel.astype(np.float32)[:, None], guess.astype(np.float32)[:, None]
    there, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, first.copy(), **settings)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, start.copy(), **settings)
    error = np.linalg.norm(back[:, 0] - start[:, 0], axis=-1)
    good = (ok[:, 0] == 1) & (returned[:, 0] == 1) & (error < largest)
    return there[:, 0].astype(np.float64), good


def depth_at(depth: NDArray[np.float32], pixel: Array) -> Array:
    """Depth (M,) [m] at pixels (M, 2): median of what is known in 3 x 3, NaN outside, where little is known, and across
    an edge."""
    height, width = depth.shape
    at = np.round(pixel).astype(int)
    inside = (at[:, 0] >= 1) & (at[:, 1] >= 1) & (at[:, 0] < width - 1) & (at[:, 1] < height - 1)
    result = np.full(len(pixel), np.nan)
    u, v = at[inside].T
    patch = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=-1).astype(np.float64)
    known = np.isfinite(patch)
    ordered = np.sort(patch, axis=-1)  # NaN at the end
    count = known.sum(axis=-1)
    row = np.arange(len(patch))
    middle = ordered[row, np.maximum(count // 2, 0).clip(max=8)]
    spread = ordered[row, np.maximum(count - 1, 0)] - ordered[:, 0]
    result[inside] = np.where((count >= 5) & (spread < 0.03), middle, np.nan)
    return result

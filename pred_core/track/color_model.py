"""Which colours are the object's: a histogram of it against one of everything else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Picture = NDArray[np.uint8]
BITS = 5  # of each channel
BLUR = 1.2  # [cells]; shading moves colours by a few cells
FAINT = 1e-3  # of the commonest colour: rarer ones are the tails of the blur
SAME_HUE = 0.12  # largest difference in the share of a primary
ENOUGH = 0.08  # share of the background that may look like the object before colour is no help


class ColorModel:
    """Likelihood ratio of object and background in 32 x 32 x 32 colours."""

    def __init__(self, object_color: Picture, background: Picture):
        """From samples (M, 3) of both."""
        likely = _histogram(object_color)
        ratio = likely / (likely + _histogram(background) + 1e-9)
        self._is_object = ((ratio > 0.5) & (likely > FAINT * likely.max())).ravel()
        self.accepted_object = float(self.matches(object_color).mean()) if len(object_color) else 0.0
        self.accepted_background = float(self.matches(background).mean()) if len(background) else 0.0

    @property
    def tells_apart(self) -> bool:
        """True if colour separates the object from the rest."""
        return self.accepted_background < ENOUGH and self.accepted_object > 0.8

    def matches(self, color: Picture) -> NDArray[np.bool_]:
        """(M,) of colours (M, 3) that are rather the object's."""
        return np.asarray(self._is_object[_code(color)])


def of_same_hue(color: Picture, sample: Picture) -> NDArray[np.bool_]:
    """(M,) of colours (M, 3) whose shares of red, green and blue are near to the median of a sample's (S, 3)."""
    usual = np.median(_shares(sample), axis=0)
    return np.asarray(np.abs(_shares(color) - usual).max(axis=-1) < SAME_HUE)


def _shares(color: Picture) -> NDArray[np.float64]:
    return np.asarray(color / np.maximum(color.sum(axis=-1, dtype=np.float64), 1.0)[:, None])


def _code(color: Picture) -> NDArray[np.int64]:
    c = (color >> (8 - BITS)).astype(np.int64)
    return np.asarray((c[..., 0] << (2 * BITS)) | (c[..., 1] << BITS) | c[..., 2])


def _histogram(color: Picture) -> NDArray[np.float64]:
    cells = 1 << BITS
    counts = np.bincount(_code(color), minlength=cells**3).reshape(cells, cells, cells).astype(np.float64)
    return np.asarray(gaussian_filter(counts / max(len(color), 1), BLUR, mode="nearest"))

"""What follows pixels of one camera through its pictures: a learned model, or a stand-in of a test."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pred_core.types import Array

Picture = NDArray[np.uint8]


class PointFollower(Protocol):
    """Follows pixels of one camera through a stream of pictures."""

    def another(self) -> PointFollower:
        """One for another camera."""

    def start(self, rgb: Picture, pixel: Array) -> None:
        """Begin with pixels (M, 2) of (H, W, 3): column and row, whole numbers in the middle of a pixel."""

    def follow(self, rgb: Picture) -> tuple[Array, NDArray[np.bool_]]:
        """Their pixels (M, 2) in the next picture, and for which of them that is an answer (M,): it sees them."""

"""A slot on the table: two upright posts with a gap between them, through which a line is to be led."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pred_core.config import setting
from pred_core.types import Array, Box


@dataclass(frozen=True)
class Slot:
    """Where it stands and how large it is. Its own axes: `through` the gap, `across` it, up."""

    x: float = setting(0.45, unit="m", low=-3.0, high=3.0, doc="middle of the gap in world")
    y: float = setting(0.0, unit="m", low=-3.0, high=3.0, doc="middle of the gap in world")
    z: float = setting(0.0, unit="m", low=-3.0, high=3.0, doc="foot of the posts")
    yaw: float = setting(math.pi / 2, unit="rad", low=-math.pi, high=math.pi, doc="direction through the gap in world")
    gap: float = setting(0.024, unit="m", low=0.001, high=1.0, doc="between the posts")
    width: float = setting(0.09, unit="m", low=0.001, high=1.0, doc="of a post, across")
    thickness: float = setting(0.012, unit="m", low=0.001, high=1.0, doc="of a post, through")
    height: float = setting(0.1, unit="m", low=0.001, high=1.0, doc="of a post")

    @property
    def axes(self) -> Array:
        """(3, 3) rows: through, across, up, in world."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    @property
    def foot(self) -> Array:
        """(3,) [m] world, middle of the gap at the foot."""
        return np.array([self.x, self.y, self.z])

    def posts(self) -> tuple[Box, Box]:
        """The two posts as fixtures of a scene."""
        rotation = (math.cos(0.5 * self.yaw), 0.0, 0.0, math.sin(0.5 * self.yaw))
        half = (0.5 * self.thickness, 0.5 * self.width, 0.5 * self.height)
        boxes = []
        for side in (-1.0, 1.0):
            x, y, z = self.foot + (0.0, 0.0, half[2]) + side * (0.5 * self.gap + half[1]) * self.axes[1]
            boxes.append(Box((float(x), float(y), float(z)), half, rotation))
        return boxes[0], boxes[1]

"""The slot: two posts on the table with a gap between them, through which the rope shall go."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.plant.rope import NO_FRICTION
from pred_core.types import Box

Array = NDArray[np.float64]
POSTS = ("post_left", "post_right")
WALL = (0.25, 0.27, 0.3, 1.0)


@dataclass(frozen=True)
class SlotConfig:
    """Where the slot stands and how wide it is. Its own axes: x through the gap, y across, z up."""

    x: float = setting(0.45, unit="m", low=-2.0, high=2.0, doc="middle of the gap in world")
    y: float = setting(0.0, unit="m", low=-2.0, high=2.0, doc="middle of the gap in world")
    yaw: float = setting(np.pi / 2, unit="rad", low=-np.pi, high=np.pi, doc="direction through the gap in world")
    height: float = setting(0.10, unit="m", low=0.01, high=0.5, doc="of the posts")
    width: float = setting(0.09, unit="m", low=0.005, high=0.5, doc="of each post, across")
    thickness: float = setting(0.012, unit="m", low=0.002, high=0.2, doc="of the posts, along the way through")
    gap: float = setting(0.024, unit="m", low=0.004, high=0.5, doc="between the posts")

    @property
    def world_from_slot(self) -> Array:
        """(4, 4); the slot's origin is on the table in the middle of the gap."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0, self.x], [s, c, 0.0, self.y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])

    @property
    def boxes(self) -> tuple[Box, Box]:
        """The posts as fixtures in world, for whoever plans around them."""
        half = (0.5 * self.thickness, 0.5 * self.width, 0.5 * self.height)
        turn = (float(np.cos(0.5 * self.yaw)), 0.0, 0.0, float(np.sin(0.5 * self.yaw)))
        made = []
        for side in (1.0, -1.0):
            center = self.world_from_slot @ [0.0, side * 0.5 * (self.gap + self.width), 0.5 * self.height, 1.0]
            made.append(Box((float(center[0]), float(center[1]), float(center[2])), half, turn))
        return made[0], made[1]

    def to_slot(self, p_world: Array) -> Array:
        """Points (..., 3) [m] in the slot's axes."""
        pose = self.world_from_slot
        return (np.asarray(p_world, float) - pose[:3, 3]) @ pose[:3, :3]


def add_slot(spec: mujoco.MjSpec, slot: SlotConfig, contype: int, conaffinity: int) -> None:
    """Stand the posts on the table of a model."""
    for name, box in zip(POSTS, slot.boxes, strict=True):
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=list(box.center),
            quat=list(box.rotation),
            size=list(box.half_size),
            friction=list(NO_FRICTION),
            contype=contype,
            conaffinity=conaffinity,
            rgba=list(WALL),
        )

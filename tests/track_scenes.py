"""Scenes for tracker tests: a straight hanging rope and what small cameras see of it."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from pred_core.plant.appearance import dress_rope, dress_spec
from pred_core.plant.cameras import CameraConfig, Cameras, ring_of_cameras
from pred_core.plant.rope import RopeConfig, build_rope
from pred_core.types import Array, CameraFrame

LENGTH = 0.5  # [m]
GRIPPER = np.array([0.05, -0.02, 0.6])  # [m] world
TARGET = (0.0, 0.0, 0.35)  # [m] world, what the cameras look at
TURN = np.array([[1.0, 0.0, 0.0, 0.0]])  # wxyz of the only gripper
STEP = 66_000_000  # [ns] between pictures


class HangingRope:
    """A straight rope below its gripper, rendered in 320 x 240."""

    def __init__(self, cameras: int = 3):
        rope = build_rope(RopeConfig(length=LENGTH))
        dress_spec(rope.spec)
        dress_rope(rope)
        self.model = rope.spec.compile()
        self.data = mujoco.MjData(self.model)
        self.configs: tuple[CameraConfig, ...] = ring_of_cameras(cameras, TARGET, width=320, height=240)
        self.cameras = Cameras(self.model, self.configs)
        self.generator = np.random.default_rng(0)
        self.move(np.zeros(3))

    def move(self, shift: Array) -> None:
        """Put the gripper `shift` [m] away from GRIPPER; the rope stays straight."""
        self.gripper = GRIPPER + shift
        self.data.qpos[:3] = self.gripper
        mujoco.mj_forward(self.model, self.data)

    def truth(self, count: int) -> Array:
        """(count, 3) [m] world, from the gripper down."""
        down = np.linspace(0.0, LENGTH, count)
        return self.gripper - np.outer(down, (0.0, 0.0, 1.0))

    def frames(self, stamp: int) -> dict[str, CameraFrame]:
        """A picture of every camera at `stamp` [ns]."""
        return {n: self.cameras.frame(self.data, n, stamp, self.generator) for n in self.cameras.configs}

    def grip(self, stamp: int) -> dict[str, Any]:
        """Arguments of `Tracker.add_grip`."""
        return {"stamp": stamp, "position": self.gripper[None], "rotation": TURN, "closed": np.array([True])}

    def close(self) -> None:
        """Free the GL context."""
        self.cameras.close()

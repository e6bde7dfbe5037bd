"""What the sensors get wrong; the rope itself moves as ever. Applied where the data are written."""

from __future__ import annotations

import numpy as np

from pred_core.plant.hidden.effect import Array, Entry, HiddenEffect


class ActionDelay(HiddenEffect):
    """What the tracker shows happened earlier than its stamps say, relative to the gripper's stamps."""

    @property
    def delay(self) -> float:
        """The magnitude, [ms] to [s]."""
        return self.magnitude * 1e-3


class CameraScale(HiddenEffect):
    """All tracks are scaled about a camera at a drawn place beside the table."""

    def observe(self, position: Array) -> Array:
        """c + (1 + a)(x - c)."""
        camera = camera_place(self.generator)
        return position + self.magnitude * (position - camera)


class CameraRotation(HiddenEffect):
    """All tracks are turned about a drawn axis through a camera at a drawn place."""

    def observe(self, position: Array) -> Array:
        """c + R (x - c)."""
        camera = camera_place(self.generator)
        axis = self.generator.normal(size=3)
        axis /= np.linalg.norm(axis)
        angle = np.radians(self.magnitude)
        x = position - camera
        turned = x * np.cos(angle) + np.cross(axis, x) * np.sin(angle)
        turned += axis * (x @ axis)[..., None] * (1.0 - np.cos(angle))
        return position + (turned - x)


def camera_place(generator: np.random.Generator) -> Array:
    """(3,) [m] beside the table, 0.9 m off its middle, 0.8 m up."""
    azimuth = generator.uniform(0.0, 2.0 * np.pi)
    return np.array([0.9 * np.cos(azimuth), 0.9 * np.sin(azimuth), 0.8])


ENTRIES = (
    Entry("action_delay", "delay", "tracks are older than their stamps", "ms", 10.0, 250.0, ActionDelay),
    Entry("camera_scale", "camera", "tracks times 1 + a about the camera", "1", 0.003, 0.2, CameraScale, low=-0.2),
    Entry("camera_rotation", "camera", "tracks turned about a drawn axis through the camera", "deg",
          0.2, 15.0, CameraRotation),
)  # fmt: skip

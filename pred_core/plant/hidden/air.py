"""Forces of the surrounding air and of the gravity field."""

from __future__ import annotations

from functools import partial

import numpy as np

from pred_core.plant.hidden.effect import Entry, HiddenEffect, Make
from pred_core.plant.world import World

AIR_DENSITY = 1.2  # [kg/m^3]
CYLINDER_DRAG = 1.1  # coefficient of a cylinder across the flow, Reynolds number about 2000


class PowerDrag(HiddenEffect):
    """Force -m b |v|^(p-1) v at the middle of every link."""

    def __init__(self, power: float, magnitude: float, generator: np.random.Generator):
        super().__init__(magnitude, generator)
        self.power = power

    def act(self, world: World) -> None:
        """Add the drag of this step."""
        v = world.velocity
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        world.add_force(-self.magnitude * world.mass[:, None] * speed ** (self.power - 1.0) * v)


class Wind(HiddenEffect):
    """A steady horizontal wind across slender links (cross-flow principle); the direction is drawn.

    MuJoCo's own fluid forces make its implicit step seven times slower on this rope, for the same push.
    """

    def begin(self, world: World) -> None:
        """Draw the direction."""
        azimuth = self.generator.uniform(0.0, 2.0 * np.pi)
        self._wind = self.magnitude * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        rope = world.rope.rope
        area = 2.0 * rope.radius * rope.link_length
        self._scale = 0.5 * AIR_DENSITY * CYLINDER_DRAG * area if self.magnitude > 0.0 else 0.0

    def act(self, world: World) -> None:
        """rho / 2 C d L |u| u, u the part of the air's velocity past the link that is across its axis."""
        axis = world.data.xmat[world.links].reshape(-1, 3, 3)[:, :, 2]
        past = self._wind - world.velocity
        across = past - (past * axis).sum(axis=1, keepdims=True) * axis
        world.add_force(self._scale * np.linalg.norm(across, axis=1, keepdims=True) * across)


class Gust(HiddenEffect):
    """A uniform force per mass along a drawn horizontal direction that swells and reverses at 0.7 Hz."""

    def begin(self, world: World) -> None:
        """Draw direction and phase."""
        azimuth, self._phase = self.generator.uniform(0.0, 2.0 * np.pi, 2)
        self._direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])

    def act(self, world: World) -> None:
        """Add the push of this step."""
        swell = np.sin(2.0 * np.pi * 0.7 * (world.session + world.time) + self._phase)
        world.add_force(self.magnitude * swell * world.mass[:, None] * self._direction)


class GravityTilt(HiddenEffect):
    """The table is not level: gravity leans by an angle towards a drawn azimuth."""

    def begin(self, world: World) -> None:
        """Turn MuJoCo's gravity vector."""
        azimuth = self.generator.uniform(0.0, 2.0 * np.pi)
        size = float(np.linalg.norm(world.model.opt.gravity))
        lean = np.radians(self.magnitude)
        side = size * np.sin(lean)
        world.model.opt.gravity[:] = (side * np.cos(azimuth), side * np.sin(azimuth), -size * np.cos(lean))


class Swirl(HiddenEffect):
    """A force across the velocity, m w z x v: it turns motion about the vertical and does no work."""

    def act(self, world: World) -> None:
        """Add the force of this step."""
        v = world.velocity
        across = np.stack([-v[:, 1], v[:, 0], np.zeros(len(v))], axis=1)
        world.add_force(self.magnitude * world.mass[:, None] * across)


def _drag(power: float) -> Make:
    return partial(PowerDrag, power)


ENTRIES = (
    Entry("drag_linear", "drag", "force -m b v", "1/s", 0.3, 30.0, _drag(1.0)),
    Entry("drag_quadratic", "drag", "force -m b |v| v", "1/m", 0.4, 30.0, _drag(2.0)),
    Entry("wind", "wind", "air of 1.2 kg/m^3 moves horizontally past round links (drag coefficient 1.1)", "m/s",
          1.5, 15.0, Wind),
    Entry("gravity_tilt", "gravity", "gravity turned by an angle", "deg", 0.8, 30.0, GravityTilt),
    Entry("drag_three_halves", "drag", "force -m b |v|^0.5 v", "(s m)^-1/2", 0.3, 30.0, _drag(1.5), unlisted=True),
    Entry("swirl", "swirl", "force m w (z x v), which does no work", "1/s", 0.2, 20.0, Swirl, unlisted=True),
    Entry("gust", "gust", "uniform force m a sin(2 pi 0.7 Hz t + phase)", "m/s^2", 0.05, 5.0, Gust, unlisted=True),
)  # fmt: skip

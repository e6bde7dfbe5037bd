"""The table: friction, height, shape, and what stands on it. The rope's own coefficient counts in every contact."""

from __future__ import annotations

from abc import ABC, abstractmethod

import mujoco
import numpy as np

from pred_core.plant.hidden.effect import Array, Entry, HiddenEffect
from pred_core.plant.rope import GROUND, NO_FRICTION, RopeModel
from pred_core.plant.world import World

PATCH_RADIUS = 0.08  # [m]
RIDGE_RADIUS, RIDGE_PITCH, RIDGES = 0.1, 0.12, 12  # [m], [m]
SHAKE_FREQUENCY = 6.0  # [Hz]
SHAKE_ARMATURE, SHAKE_BANDWIDTH = 1e4, 200.0  # [kg], [rad/s]


class LinkFriction(HiddenEffect, ABC):
    """Base of effects that give every link its own Coulomb coefficient, anew at every step."""

    def begin(self, world: World) -> None:
        """Keep the usual coefficients."""
        self._usual = world.model.geom_friction[world.geoms, 0].copy()
        self.draw(world)

    def draw(self, world: World) -> None:
        """What else the effect needs."""

    def act(self, world: World) -> None:
        """Set the coefficients; MuJoCo reads them at the next step."""
        world.model.geom_friction[world.geoms, 0] = np.maximum(self._usual * (1.0 + self.change(world)), 1e-5)

    @abstractmethod
    def change(self, world: World) -> Array:
        """Relative change (L,) of the coefficient."""


class FrictionScale(LinkFriction):
    """The same relative change everywhere."""

    def change(self, world: World) -> Array:
        """Constant."""
        return np.full(len(world.links), self.magnitude)


class FrictionDrift(LinkFriction):
    """The coefficient grows with the time of the session."""

    def change(self, world: World) -> Array:
        """Linear in time, from its usual value at the session's beginning."""
        return np.full(len(world.links), self.magnitude * max(world.session + world.time, 0.0) / 60.0)


class FrictionAnisotropic(LinkFriction):
    """More friction along a drawn direction of the table, less across it."""

    def draw(self, world: World) -> None:
        """The direction."""
        self._azimuth = self.generator.uniform(0.0, np.pi)

    def change(self, world: World) -> Array:
        """a cos 2(phi - phi0), phi the direction in which the link slides."""
        v = world.velocity
        return self.magnitude * np.cos(2.0 * (np.arctan2(v[:, 1], v[:, 0]) - self._azimuth))


class StickyPatch(LinkFriction):
    """A round place of the table with more friction, where the rope usually lies."""

    def draw(self, world: World) -> None:
        """The place."""
        self._center = np.array([-0.05, 0.0]) + self.generator.uniform(-1.0, 1.0, 2) * (0.12, 0.06)

    def change(self, world: World) -> Array:
        """A bell around the centre."""
        square = ((world.position[:, :2] - self._center) ** 2).sum(axis=1)
        return self.magnitude * np.exp(-0.5 * square / (PATCH_RADIUS * self.extent) ** 2)


class ViscousFriction(LinkFriction):
    """Sliding resists by its speed: the coefficient mu + c v, so c N v beside Coulomb's mu N.

    A force c N v of its own would need the load of the step before, which a rope that lands bears in blows of one
    step: at 18 s/m it did half to two thirds of what it did in steps an eighth as long (two episodes on the table).
    """

    def change(self, world: World) -> Array:
        """In proportion to the speed along the table."""
        return self.magnitude * np.linalg.norm(world.velocity[:, :2], axis=1) / self._usual


class TableHeight(HiddenEffect):
    """The table stands higher than everyone thinks."""

    def build(self, rope: RopeModel) -> None:
        """Lift the plane."""
        rope.ground.pos = [0.0, 0.0, self.magnitude]


class Obstacle(HiddenEffect):
    """A ball that nobody told of: half of the seeds beside the hanging rope, half on the table."""

    def build(self, rope: RopeModel) -> None:
        """Add the ball. Its surface stands 3 cm off the home of the hanging rope, or beside the lying one."""
        generator, radius = self.generator, self.magnitude
        azimuth = generator.uniform(0.0, 2.0 * np.pi)
        side = 1.0 if generator.uniform() < 0.5 else -1.0
        if generator.uniform() < 0.5:
            away = radius + 0.03
            place = [away * np.cos(azimuth), away * np.sin(azimuth), generator.uniform(0.4, 0.6)]
        else:
            place = [generator.uniform(-0.15, 0.05), side * (radius + 0.02), 0.5 * radius]
        if radius > 0.0:
            rope.spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=place, friction=list(NO_FRICTION)
            )


class TableWave(HiddenEffect):
    """Ridges across the table: cylinders sunk so that only their tops stand out."""

    def build(self, rope: RopeModel) -> None:
        """Add the ridges; the first one's place is drawn."""
        first = self.generator.uniform(0.0, RIDGE_PITCH) - 0.5 * RIDGES * RIDGE_PITCH
        for n in range(RIDGES if self.magnitude > 0.0 else 0):
            x, z = first + n * RIDGE_PITCH, self.magnitude - RIDGE_RADIUS
            rope.spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[x, -1.0, z, x, 1.0, z],
                size=[RIDGE_RADIUS, 0, 0],
                friction=list(NO_FRICTION),
            )


class TableVibration(HiddenEffect):
    """The table shakes sideways along a drawn direction: a heavy slab on a driven slide replaces the plane."""

    def build(self, rope: RopeModel) -> None:
        """Add the slab, its upper face at z = 0; the plane no longer collides."""
        azimuth = self.generator.uniform(0.0, np.pi)
        if self.magnitude <= 0.0:
            return
        rope.ground.contype = rope.ground.conaffinity = 0
        rope.ground.name = "floor"
        slab = rope.spec.worldbody.add_body(gravcomp=1.0, pos=[0.0, 0.0, -0.1])
        slab.add_joint(
            name="shake",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[np.cos(azimuth), np.sin(azimuth), 0.0],
            armature=SHAKE_ARMATURE,
        )
        slab.add_geom(
            name=GROUND, type=mujoco.mjtGeom.mjGEOM_BOX, size=[3.0, 3.0, 0.1], mass=100.0, friction=list(NO_FRICTION)
        )

    def act(self, world: World) -> None:
        """Drive the slab along A sin(w t)."""
        if self.magnitude <= 0.0:
            return
        joint = world.model.joint("shake")
        x = world.data.qpos[joint.qposadr[0]]
        v = world.data.qvel[joint.dofadr[0]]
        w = 2.0 * np.pi * SHAKE_FREQUENCY
        phase = w * (world.session + world.time)
        place, speed = self.magnitude * np.sin(phase), self.magnitude * w * np.cos(phase)
        wanted = -w * w * place + SHAKE_BANDWIDTH * (speed - v) + 0.25 * SHAKE_BANDWIDTH**2 * (place - x)
        world.data.qfrc_applied[joint.dofadr[0]] = (SHAKE_ARMATURE + 100.0) * wanted


ENTRIES = (
    Entry("friction_scale", "friction", "Coulomb coefficient times 1 + a", "1", 0.4, 4.0, FrictionScale, low=-0.95),
    Entry("friction_viscous", "friction", "coefficient mu + c v, v the speed along the table", "s/m",
          2.0, 30.0, ViscousFriction),
    Entry("friction_anisotropic", "friction", "coefficient times 1 + a cos 2(sliding direction - drawn direction)", "1",
          0.33, 1.0, FrictionAnisotropic),
    Entry("sticky_patch", "patch", "coefficient times 1 + a exp(-d^2 / 2 (0.08 m)^2) about a drawn place", "1",
          2.0, 20.0, StickyPatch, low=-0.95),
    Entry("table_height", "table", "the table plane stands at z = h", "m", 0.005, 0.06, TableHeight, low=-0.06),
    Entry("obstacle", "obstacle", "a fixed ball of radius r at a drawn place", "m", 0.02, 0.15, Obstacle),
    Entry("friction_drift", "drift", "coefficient times 1 + a t, t the time of the session", "1/min",
          0.3, 5.0, FrictionDrift, low=-0.3),
    Entry("table_wave", "table", "ridges of height h every 0.12 m along x", "m",
          0.0035, 0.03, TableWave, unlisted=True),
    Entry("table_vibration", "table", "the table moves along a drawn direction as A sin(2 pi 6 Hz t)", "m",
          0.003, 0.01, TableVibration, unlisted=True),
)  # fmt: skip

"""What the rope is made of: stiffness, mass, damping, rest shape. Material coordinates stay with the rope."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from pred_core.plant.hidden.effect import Array, Entry, HiddenEffect
from pred_core.plant.rope import FIRM, FIRM_REF, RopeModel
from pred_core.plant.world import World

TIP = 0.1  # share of the length that is the tip
REGION = 0.2  # share of the length that is the stiff region


class BendingStiffness(HiddenEffect):
    """All joint springs, by the same factor."""

    def begin(self, world: World) -> None:
        """Scale MuJoCo's joint stiffness."""
        world.model.jnt_stiffness[world.joints] *= 1.0 + self.magnitude * self.where(world)

    def where(self, world: World) -> Array:
        """Weight (J,) of the change at each joint."""
        return np.ones(len(world.joints))


class StiffRegion(BendingStiffness):
    """Joint springs of a fifth (times `extent`) of the rope, at a drawn place."""

    def where(self, world: World) -> Array:
        """One inside the region."""
        width = REGION * self.extent
        begin = self.generator.uniform(0.15, 0.85 - width)
        s = world.rope.joint_material[world.joint_link]
        return ((s >= begin) & (s <= begin + width)).astype(float)


class StiffnessDrift(HiddenEffect):
    """All joint springs, growing with the time of the session."""

    def begin(self, world: World) -> None:
        """Keep the usual stiffness."""
        self._usual = world.model.jnt_stiffness[world.joints].copy()

    def act(self, world: World) -> None:
        """Linear in time."""
        minutes = max(world.session + world.time, 0.0) / 60.0
        world.model.jnt_stiffness[world.joints] = self._usual * (1.0 + self.magnitude * minutes)


class Mass(HiddenEffect, ABC):
    """Base: masses and inertias of the links, each by its own factor, before the model is compiled."""

    def build(self, rope: RopeModel) -> None:
        """Scale the capsules' masses; MuJoCo derives the inertias."""
        for link, factor in zip(rope.links, 1.0 + self.magnitude * self.where(rope.material), strict=True):
            for geom in link.geoms:
                geom.mass = geom.mass * float(factor)

    @abstractmethod
    def where(self, material: Array) -> Array:
        """Weight (L,) of the change."""


class HeavyTip(Mass):
    """The last tenth (times `extent`) of the rope, at the end that is usually free, is heavier."""

    def where(self, material: Array) -> Array:
        """One at the tip."""
        return (material > 1.0 - TIP * self.extent).astype(float)


class MassGradient(Mass):
    """Mass grows along the rope; the whole stays as heavy."""

    def where(self, material: Array) -> Array:
        """s - 1/2."""
        return material - 0.5


class InternalDamping(HiddenEffect):
    """All joint dampers, by the same factor."""

    def begin(self, world: World) -> None:
        """Scale MuJoCo's joint damping."""
        dofs = (world.joint_dof[:, None] + np.arange(3)).ravel()
        world.model.dof_damping[dofs] *= 1.0 + self.magnitude


class RestCurvature(HiddenEffect):
    """The rope came off a spool: every joint rests at an angle about one drawn axis across the rope."""

    def begin(self, world: World) -> None:
        """Turn the joints' reference orientation."""
        azimuth = self.generator.uniform(0.0, 2.0 * np.pi)
        half = 0.5 * self.magnitude * world.rope.rope.link_length * (-1.0 if world.rope.reversed else 1.0)
        # Seen from the other end the same curve bends about the opposite axis.
        axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        rest = np.concatenate([[np.cos(half)], np.sin(half) * axis])
        for at in world.joint_qpos:
            world.model.qpos_spring[at : at + 4] = rest


class Creep(HiddenEffect):
    """The rest shape follows the shape: a joint forgets its angle at a constant rate while it is bent."""

    def begin(self, world: World) -> None:
        """Where the joints' quaternions are; the rest shape is that of a fresh rope."""
        self._at = world.joint_qpos[:, None] + np.arange(4)

    def act(self, world: World) -> None:
        """Move each rest orientation towards the present one, from time 0 on."""
        if world.time < 0.0:
            return
        rest, now = world.model.qpos_spring[self._at], world.data.qpos[self._at]
        now = now * np.where((rest * now).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        moved = rest + self.magnitude * world.model.opt.timestep * (now - rest)
        if self.magnitude > 0.0:
            world.model.qpos_spring[self._at] = moved / np.linalg.norm(moved, axis=1, keepdims=True)


class HingeFriction(HiddenEffect):
    """One joint, where the rope often bends, is damaged: dry friction holds it where it is."""

    def begin(self, world: World) -> None:
        """Give one drawn joint MuJoCo's friction loss."""
        wanted = self.generator.uniform(0.12, 0.25)
        joint = int(np.abs(world.rope.joint_material[world.joint_link] - wanted).argmin())
        dof = int(world.joint_dof[joint])
        world.model.dof_frictionloss[dof : dof + 3] = self.magnitude
        world.model.dof_solref[dof : dof + 3] = FIRM_REF
        world.model.dof_solimp[dof : dof + 3] = FIRM


ENTRIES = (
    Entry("bending_stiffness", "bending", "joint springs times 1 + a", "1", 0.4, 20.0, BendingStiffness, low=-0.9),
    Entry("stiff_region", "bending", "joint springs times 1 + a in a drawn fifth of the rope", "1",
          3.0, 20.0, StiffRegion, low=-0.9),
    Entry("heavy_tip", "mass", "masses of the last tenth times 1 + a", "1", 1.0, 20.0, HeavyTip, low=-0.9),
    Entry("mass_gradient", "mass", "masses times 1 + a (s - 1/2)", "1", 0.4, 1.9, MassGradient, low=-1.9),
    Entry("internal_damping", "damping", "joint dampers times 1 + a", "1", 2.0, 50.0, InternalDamping, low=-0.95),
    Entry("creep", "plastic", "rest angles follow the angles at rate r", "1/s", 0.2, 5.0, Creep),
    Entry("rest_curvature", "rest_shape", "rest curvature about a drawn axis", "1/m", 2.0, 20.0, RestCurvature),
    Entry("stiffness_drift", "drift", "joint springs times 1 + a t, t the time of the session", "1/min",
          0.3, 3.0, StiffnessDrift, low=-0.3),
    Entry("hinge_friction", "hinge", "dry friction in one drawn joint of the rope", "N m",
          2e-3, 5e-2, HingeFriction, unlisted=True),
)  # fmt: skip

"""How the rope is held, and what else pulls at it from outside."""

from __future__ import annotations

import mujoco
import numpy as np

from pred_core.plant.hidden.effect import Entry, HiddenEffect
from pred_core.plant.rope import FIRM, FIRM_REF, RopeModel
from pred_core.plant.world import World

ATTRACTION_RANGE = 0.15  # [m]
REPULSION_RANGE = 0.08  # [m]
SLIP_DAMPING = 5.0  # [N s/m] of a rope that slides in the jaws
HELD_FAST = 1e3  # [N] friction loss of jaws that do not slip


class GripperSlip(HiddenEffect):
    """The jaws hold no more than 1/M newtons; beyond that the rope slides out along them."""

    def build(self, rope: RopeModel) -> None:
        """Let the first link slide along the jaws."""
        if self.magnitude > 0.0:
            rope.links[0].add_joint(
                name="slip",
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=[0.0, 0.0, 1.0],
                frictionloss=HELD_FAST,
                solref_friction=FIRM_REF,
                solimp_friction=FIRM,
                damping=SLIP_DAMPING * self.extent,
            )

    def act(self, world: World) -> None:
        """From time 0 on the jaws hold with their limited force."""
        if self.magnitude > 0.0 and world.time >= 0.0:
            dof = int(world.model.joint("slip").dofadr[0])
            world.model.dof_frictionloss[dof] = 1.0 / self.magnitude


class GripperOffset(HiddenEffect):
    """The jaws are not where the robot's tool frame says: a constant offset, which turns with the gripper.

    The rope is attached off the reported frame, so that what the robot reports stays the same.
    """

    def build(self, rope: RopeModel) -> None:
        """Shift the first link in the gripper's frame, mostly across the rope."""
        azimuth, lift = self.generator.uniform(0.0, 2.0 * np.pi), self.generator.uniform(-0.4, 0.4)
        direction = np.array([np.cos(azimuth) * np.cos(lift), np.sin(azimuth) * np.cos(lift), np.sin(lift)])
        rope.links[0].pos = rope.links[0].pos + self.magnitude * direction


class Attraction(HiddenEffect):
    """A force per mass towards a fixed place, strongest at a distance r from it."""

    def begin(self, world: World) -> None:
        """Draw the place: between where ropes hang and where they lie."""
        self._center = np.array([0.0, 0.0, 0.35]) + self.generator.uniform(-1.0, 1.0, 3) * (0.15, 0.15, 0.2)

    def act(self, world: World) -> None:
        """a (d / r) exp(1/2 - d^2 / 2 r^2) per mass."""
        away, reach = self._center - world.position, ATTRACTION_RANGE * self.extent
        square = (away**2).sum(axis=1, keepdims=True) / reach**2
        world.add_force(self.magnitude * world.mass[:, None] * away / reach * np.exp(0.5 - 0.5 * square))


class Tether(HiddenEffect):
    """A thread from a point of the rope to a fixed anchor: MuJoCo's spatial tendon, slack until it is taut."""

    def build(self, rope: RopeModel) -> None:
        """Tie a drawn link to a drawn anchor; the thread is just taut where that link hangs at home."""
        s, azimuth = self.generator.uniform(0.55, 0.9), self.generator.uniform(0.0, 2.0 * np.pi)
        link = int(np.abs(rope.material - s).argmin())
        anchor = np.array([0.3 * np.cos(azimuth), 0.3 * np.sin(azimuth), 1.0 - 0.7 * s])
        if self.magnitude <= 0.0:
            return
        rope.spec.worldbody.add_site(name="anchor", pos=list(anchor))
        rope.links[link].add_site(name="tied", pos=[0.0, 0.0, -0.5 * rope.rope.link_length])
        thread = rope.spec.add_tendon(
            name="thread", stiffness=[self.magnitude, 0.0, 0.0], springlength=[0.0, 0.32], limited=False
        )
        thread.wrap_site("anchor")
        thread.wrap_site("tied")


class Repulsion(HiddenEffect):
    """Links that are not neighbours push each other away at short range."""

    def act(self, world: World) -> None:
        """a exp(-d / r) per mass between links that are more than two apart."""
        p = world.position
        away = p[:, None] - p[None]
        distance = np.linalg.norm(away, axis=-1)
        count = len(p)
        apart = np.abs(np.arange(count)[:, None] - np.arange(count)[None]) > 2
        size = np.where(apart, np.exp(-distance / (REPULSION_RANGE * self.extent)) / np.maximum(distance, 1e-6), 0.0)
        share = world.mass[:, None] * world.mass[None] / world.mass.mean()
        world.add_force(self.magnitude * ((size * share)[..., None] * away).sum(axis=1))


ENTRIES = (
    Entry("gripper_slip", "slip", "jaws hold at most 1/M; beyond, the rope slides along them", "1/N",
          2.5, 50.0, GripperSlip),
    Entry("gripper_offset", "gripper_offset", "rope held off the reported frame by a constant vector of it", "m",
          0.003, 0.05, GripperOffset),
    Entry("attraction", "attraction", "force m a (d/r) exp(1/2 - d^2/2r^2) to a drawn place, r = 0.15 m", "m/s^2",
          0.15, 10.0, Attraction),
    Entry("tether", "tether", "thread of stiffness k from a drawn point of the rope to a drawn anchor", "N/m",
          0.05, 3.0, Tether),
    Entry("repulsion", "repulsion", "force m a exp(-d/r) between links more than two apart, r = 0.08 m", "m/s^2",
          3.0, 100.0, Repulsion, unlisted=True),
)  # fmt: skip

"""One episode of the rope: compile, settle, move the gripper, record the material points."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.errors import DivergenceError
from pred_core.plant.contact_bias import add_contact_bias
from pred_core.plant.drive import DOF, Drive
from pred_core.plant.hidden.effect import HiddenEffect
from pred_core.plant.motion import Motion
from pred_core.plant.posture import laid_angles
from pred_core.plant.rope import GROUND, STEP, RopeModel

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SETTLE = 1.8  # [s] before recording time 0; damped, then free
FREE = 0.3  # [s] of it without the damping
SETTLE_DRAG = 8.0  # [1/s] near the critical damping of the hanging rope, sqrt(g / 0.7 m) = 3.7 rad/s
LEAD = 0.3  # [s] recorded before time 0, so that a delayed tracker has something to report
LARGEST_SPEED = 100.0  # [m/s]


@dataclass(frozen=True)
class Record:
    """What happened at every step from time -LEAD on."""

    time: Array  # (T,) [s]
    position: Array  # (T, P, 3) [m] world, material points in material order
    gripper: Array  # (T, 6) drive coordinates that were reached
    reference: Array  # (T, 6) drive coordinates that were asked for

    def position_at(self, time: Array) -> Array:
        """Positions (M, P, 3) [m] at times (M,) [s], linear between steps."""
        return _between(self.time, self.position, time)

    def gripper_at(self, time: Array) -> Array:
        """Drive coordinates (M, 6) of the reference at times (M,) [s].

        The drive stays within 0.1 mm of it whatever it carries (a test), so the reference is what the gripper did, and
        no bit of it depends on what is hidden.
        """
        return _between(self.time, self.reference, time)


class Pusher(Protocol):
    """What moves the gripper; `Drive` is one."""

    def push(self, data: mujoco.MjData, step: int) -> None:
        """Set the forces of a step."""
        ...


class World:
    """A compiled rope and what effects may read and change between MuJoCo's two half steps."""

    def __init__(self, rope: RopeModel, effects: Sequence[HiddenEffect] = (), session: float = 0.0):
        self.rope, self.effects = rope, tuple(effects)
        for effect in self.effects:
            effect.build(rope)
        self.model: mujoco.MjModel = rope.spec.compile()
        self.data = mujoco.MjData(self.model)
        self.links: Index = np.array([self.model.body(b.name).id for b in rope.links])
        self.geoms: Index = np.array([self.model.geom(b.name).id for b in rope.links])
        self.ground = int(self.model.geom(GROUND).id)
        jointed = [(i, self.model.joint(j.name).id) for i, j in enumerate(rope.joints) if j is not None]
        self.joint_link: Index = np.array([i for i, _ in jointed])  # (J,) the link that hangs on each ball joint
        self.joints: Index = np.array([j for _, j in jointed])
        self.joint_qpos: Index = self.model.jnt_qposadr[self.joints].astype(np.int64)
        self.joint_dof: Index = self.model.jnt_dofadr[self.joints].astype(np.int64)
        self.mass: Array = self.model.body_mass[self.links].copy()
        self.material: Array = rope.material
        self.time = 0.0  # [s] of the recording; negative while it settles
        self.session = session  # [s] of the whole session at time 0

    @property
    def position(self) -> Array:
        """(L, 3) [m] middles of the links."""
        return self.data.xipos[self.links]

    @property
    def velocity(self) -> Array:
        """(L, 3) [m/s] of the middles of the links (cvel is taken at the tree's centre of mass)."""
        spatial = self.data.cvel[self.links]
        arm = self.data.xipos[self.links] - self.data.subtree_com[self.model.body_rootid[self.links]]
        return spatial[:, 3:] + np.cross(spatial[:, :3], arm)

    def add_force(self, force: Array) -> None:
        """Add forces (L, 3) [N] at the middles of the links for this step."""
        self.data.xfrc_applied[self.links, :3] += force

    def finer(self, parts: int) -> None:
        """From now on MuJoCo's step is this part of `STEP`; contacts and springs keep their own times."""
        self.model.opt.timestep = STEP / parts

    def step(self, drive: Pusher | None = None, index: int = 0, drag: float = 0.0) -> None:
        """One MuJoCo step; the drive follows its reference `index`."""
        mujoco.mj_step1(self.model, self.data)
        self.finish_step(drive, index, drag)

    def finish_step(self, drive: Pusher | None, index: int, drag: float) -> None:
        """The second half of a step: effects, drive, forces, integration."""
        data = self.data
        add_contact_bias(self.model, data)
        data.xfrc_applied[:] = 0.0
        if drag:
            self.add_force(-drag * self.mass[:, None] * self.velocity)
        for effect in self.effects:
            effect.act(self)
        if drive is not None:
            drive.push(data, index)
        mujoco.mj_step2(self.model, data)

    def material_points(self, arc: Array) -> Array:
        """Positions (P, 3) [m] of material points at `arc` (P,) [m] from the gripper's end."""
        length = self.rope.rope.link_length
        link = np.minimum((arc / length).astype(int), len(self.links) - 1)
        down = -self.data.xmat[self.links[link]].reshape(-1, 3, 3)[:, :, 2]
        return self.data.xpos[self.links[link]] + (arc - link * length)[:, None] * down


def run_episode(world: World, motion: Motion, seconds: float, particles: int, parts: int = 1) -> Record:
    """Settle the rope, then move it for `seconds` [s]; `particles` material points evenly along the rope.

    parts: MuJoCo's steps in a `STEP`, at whose beginnings it is recorded. Raises: DivergenceError if MuJoCo's state
    blows up.
    """
    settle, steps, lead = round(SETTLE / STEP), round(seconds / STEP), round(LEAD / STEP)
    count = settle + steps + 2
    asked = motion.path(-SETTLE, count, STEP)
    drive = Drive(asked if parts == 1 else motion.path(-SETTLE, parts * count, STEP / parts))
    world.finer(parts)
    drive.place(world.data)
    lay(world, motion)
    world.time = -SETTLE
    for effect in world.effects:
        effect.begin(world)
    rope = world.rope.rope
    arc = np.linspace(0.0, rope.length, particles)
    position = np.empty((count - settle + lead, particles, 3))
    gripper = np.empty((len(position), DOF))
    with mujoco_warnings() as warnings:
        for k in range(count):
            world.time = (k - settle) * STEP
            mujoco.mj_step1(world.model, world.data)
            row = k - settle + lead
            if row >= 0:
                position[row] = world.material_points(arc)
                gripper[row] = world.data.qpos[:DOF]
            drag = SETTLE_DRAG if world.time < -FREE else 0.0
            world.finish_step(drive, parts * k, drag)
            for part in range(1, parts):
                world.time = (k - settle + part / parts) * STEP
                world.step(drive, parts * k + part, drag)
            if warnings:
                break
    speed = float(np.abs(np.diff(position[: max(row + 1, 0)], axis=0)).max(initial=0.0)) / STEP
    if warnings or not speed < LARGEST_SPEED:
        raise DivergenceError(
            "the rope's simulation became unstable",
            got=warnings[0] if warnings else f"{speed:.3g} m/s",
            next_step="Use another seed" + (", or a smaller magnitude" if world.effects else ""),
        )
    if world.rope.reversed:
        position = position[:, ::-1]
    time = STEP * np.arange(-lead, len(position) - lead, dtype=np.float64)
    return Record(time, np.ascontiguousarray(position), gripper, asked.position[settle - lead :])


def lay(world: World, motion: Motion) -> None:
    """Bend the rope so that it hangs along -z of the gripper or slants down to the table and lies flat on it."""
    rope = world.rope.rope
    angles = laid_angles(motion, rope.links, rope.link_length, rope.clamped, rope.radius)
    for i, joint in enumerate(world.rope.joints):
        if joint is not None:
            at = int(world.model.joint(joint.name).qposadr[0])
            half = 0.5 * (angles[i] - angles[i - 1])
            world.data.qpos[at : at + 4] = (np.cos(half), 0.0, np.sin(half), 0.0)


@contextlib.contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """What MuJoCo warns of meanwhile. By itself it would print it and append it to a file in the working directory."""
    texts: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(texts.append)
    try:
        yield texts
    finally:
        mujoco.set_mju_user_warning(before)


def _between(at: Array, values: Array, time: Array) -> Array:
    """Linear interpolation of values (T, ...) given at `at` (T,) for times (M,)."""
    after = np.clip(np.searchsorted(at, time), 1, len(at) - 1)
    weight = (time - at[after - 1]) / (at[after] - at[after - 1])
    weight = weight.reshape(-1, *([1] * (values.ndim - 1)))
    return (1.0 - weight) * values[after - 1] + weight * values[after]

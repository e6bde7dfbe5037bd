"""The robot cell in lock-step: rope, slot, gripper or arm and cameras, advanced only when asked, repeatable by seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.errors import DivergenceError, InputError
from pred_core.plant.appearance import dress_rope, dress_spec
from pred_core.plant.cameras import CameraConfig, Cameras, ring_of_cameras
from pred_core.plant.live.arm7 import Arm7
from pred_core.plant.live.cable import NOMINAL, draw_cable
from pred_core.plant.live.faults import CameraFaults
from pred_core.plant.live.free_gripper import FreeGripper
from pred_core.plant.live.jaws import TOOL_FROM_LINK, Jaws, add_grasp
from pred_core.plant.live.mover import (
    HAND,
    TOOL,
    Mover,
    Segment,
    ToolPose,
    make_pose,
    matrix_of,
    quaternion_of_matrix,
    tool_down,
    turn_onto,
)
from pred_core.plant.live.slot import SlotConfig, add_slot
from pred_core.plant.live.start import Start, StartFamily, draw_start
from pred_core.plant.live.success import Passage, judge_passage
from pred_core.plant.live.touches import TouchCounter, Touches
from pred_core.plant.rope import STEP, RopeConfig, build_rope
from pred_core.plant.sensing import FIRST_STAMP
from pred_core.plant.world import World, mujoco_warnings
from pred_core.types import CameraFrame

Array = NDArray[np.float64]
PERIOD = 1.0 / 30.0  # [s] of a step unless told otherwise
SETTLE, FREE, SETTLE_DRAG = 1.6, 0.6, 8.0  # [s], of it without drag [s], [1/s]: the rope comes to rest first
# Of the solver, relative to the mean inertia: the free gripper's is large. A coarser one leaves the rope trembling.
TOLERANCE = {"arm": 1e-6, "free": 1e-9}
WORKPLACE = (0.45, 0.0, 0.03)  # [m] what the cameras look at


@dataclass(frozen=True)
class CellConfig:
    """Which cell. The cable belongs to the cell; the start pose is drawn at each reset."""

    mover: str = setting("arm", choices=("arm", "free"), doc="an xArm7-class arm, or a gripper without one")
    cable: int = setting(0, low=0, high=2**31 - 1, doc="0: the nominal cable; else the seed of a drawn one")
    particles: int = setting(30, low=8, high=200, doc="true material points, evenly along the rope")
    base_x: float = setting(0.0, unit="m", low=-2.0, high=2.0, doc="the arm's base in world")
    base_y: float = setting(0.0, unit="m", low=-2.0, high=2.0, doc="the arm's base in world")
    base_z: float = setting(0.0, unit="m", low=-2.0, high=2.0, doc="the arm's base in world")
    base_yaw: float = setting(0.0, unit="rad", low=-np.pi, high=np.pi, doc="the base's turn about world z")


@dataclass(frozen=True)
class Truth:
    """What really is, at `stamp`. A loop with cameras reads gripper, closed and joints only, as from a real arm."""

    stamp: int  # [ns]
    rope: Array  # (P, 3) [m] world, material points from the end that is held at first
    rope_velocity: Array  # (P, 3) [m/s] world
    gripper: ToolPose  # measured
    closed: bool  # what the jaws report
    holds: bool  # whether the rope is in them
    joints: dict[str, float]  # [rad]; empty without an arm


class Cell:
    """`reset(seed)`, then `step(command)` as often as wanted; `look()` for pictures. Close it, or use `with`."""

    def __init__(
        self,
        config: CellConfig | None = None,
        *,
        slot: SlotConfig | None = None,
        rope: RopeConfig | None = None,
        start: StartFamily | None = None,
        cameras: Sequence[CameraConfig] | None = None,
    ):
        """`rope` overrides the cable that `config` names; `cameras` None: four at 1 m around the slot."""
        self.config, self.slot, self._family = config or CellConfig(), slot or SlotConfig(), start
        drawn = draw_cable(np.random.default_rng([self.config.cable, 9])) if self.config.cable else NOMINAL
        self.rope = rope or drawn
        self.cameras = tuple(cameras) if cameras is not None else ring_of_cameras(target=WORKPLACE)
        self.faults = CameraFaults(self.cameras)
        self._mover = _make_mover(self.config)
        self.world = self._build()
        self._tool = int(self.world.model.body(TOOL).id)
        self.jaws = Jaws(self.world)
        self._touches = TouchCounter(self.world.model, self.world.geoms)
        self._arc = np.linspace(0.0, self.rope.length, self.config.particles)
        self._eyes: Cameras | None = None
        self._seed: int | None = None
        self._steps = 0  # MuJoCo steps since the reset
        self._share = 0.0

    # Time.

    def reset(self, seed: int) -> Truth:
        """Draw a start pose, let the rope come to rest, set the time to 0, end all faults. Raises: ConfigError."""
        start = draw_start(np.random.default_rng([seed, 8]), self.rope, self.slot, self._family)
        return self.reset_to(start, seed)

    def reset_to(self, start: Start, seed: int = 0) -> Truth:
        """Begin at a given start; the seed decides noise and bumps. Raises: InputError if it is out of reach."""
        mujoco.mj_resetData(self.world.model, self.world.data)
        self.faults.kill(())
        self.faults.bump((), seed)
        self.jaws.reset()
        self._seed, self._steps = seed, 0
        pose = ToolPose(start.gripper, tool_down(start.yaw))
        self._mover.place(self.world.data, pose)
        self._reference = pose
        self._lay(start)
        self._advance(round(SETTLE / STEP), settling=True)
        self._steps = 0
        self._touches.clear()
        return self.truth()

    def step(self, command: ToolPose | None = None, seconds: float = PERIOD) -> Truth:
        """Advance by `seconds`; at the end of it the tool shall be at `command` (None: stay at the last one).

        Raises: InputError for a command that is not finite, too far for its time or out of reach (nothing moves then),
        or a time that is not a multiple of 1/300 s; DivergenceError if MuJoCo's state blows up.
        """
        if self._seed is None:
            raise InputError("cell: step before reset", next_step="Call reset(seed) first")
        count = round(seconds / STEP)
        if count < 1 or abs(count * STEP - seconds) > 1e-6:
            raise InputError("cell: time of a step", got=f"{seconds} s", allowed="multiples of 1/300 s")
        target = self._reference if command is None else make_pose(command.position, command.rotation)
        segment = Segment(self._reference, target, seconds)
        segment.check()
        self._mover.aim(segment)
        self._reference = target
        self._advance(count)
        return self.truth()

    def _advance(self, count: int, settling: bool = False) -> None:
        with mujoco_warnings() as warnings:
            for k in range(count):
                self._share = 1.0 if settling else (k + 1) / count
                drag = SETTLE_DRAG if settling and k * STEP < SETTLE - FREE else 0.0
                self.world.step(self, k, drag)
                self._steps += 1
                self._touches.see(self.world.data, self.time, STEP)
                if warnings:
                    raise DivergenceError("the cell's simulation became unstable", got=warnings[0])
        # Bring positions of bodies up to date with the joints, for measurements and pictures.
        mujoco.mj_kinematics(self.world.model, self.world.data)
        mujoco.mj_comPos(self.world.model, self.world.data)
        mujoco.mj_comVel(self.world.model, self.world.data)

    def push(self, data: mujoco.MjData, step: int) -> None:
        """Called by the world in every MuJoCo step: the forces of the drive."""
        self._mover.push(data, self._share)

    # What is.

    @property
    def time(self) -> float:
        """[s] since the reset."""
        return self._steps * STEP

    @property
    def stamp(self) -> int:
        """[ns] of now."""
        return FIRST_STAMP + round(self._steps * 1_000_000_000 / 300)

    @property
    def reference(self) -> ToolPose:
        """The pose commanded last."""
        return self._reference

    @property
    def touches(self) -> Touches:
        """Collisions since the reset."""
        return self._touches.touches

    def truth(self) -> Truth:
        """What really is, now."""
        data = self.world.data
        gripper = ToolPose(data.xpos[self._tool].copy(), data.xquat[self._tool].copy())
        points = self.world.material_points(self._arc)
        velocity = self._velocity(points)
        closed, holds = self.jaws.closed, self.jaws.holds
        return Truth(self.stamp, points, velocity, gripper, closed, holds, self._mover.joints(data))

    def nodes(self) -> Array:
        """(links + 1, 3) [m] world: the ends of the rope's links."""
        return self.world.material_points(np.linspace(0.0, self.rope.length, self.rope.links + 1))

    def judge(self) -> Passage:
        """How the rope goes through the slot, now."""
        return judge_passage(self.nodes(), self.world.data.xpos[self._tool], self.slot)

    def look(self, names: Sequence[str] | None = None) -> tuple[CameraFrame | None, ...]:
        """Pictures of now by these cameras (None: all), None for a dead one. Noise depends on seed, camera and stamp.

        Use it in one thread. Raises: InputError where nothing can be rendered; ConfigError for an unknown name.
        """
        if self._seed is None:
            raise InputError("cell: look before reset", next_step="Call reset(seed) first")
        if self._eyes is None:
            self._eyes = Cameras(self.world.model, self.cameras)
        known = [c.name for c in self.cameras]
        return tuple(self._picture(self._eyes, name, known) for name in (known if names is None else names))

    def close(self) -> None:
        """Free the cameras."""
        if self._eyes is not None:
            self._eyes.close()
            self._eyes = None

    def __enter__(self) -> Cell:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _picture(self, eyes: Cameras, name: str, known: list[str]) -> CameraFrame | None:
        if name in self.faults.dead:
            return None
        number = known.index(name) if name in known else 0  # an unknown name is refused below
        generator = np.random.default_rng([self._seed or 0, 6, number, self._steps])
        return eyes.frame(self.world.data, name, self.stamp, generator, bumped=self.faults.bumped.get(name))

    def _velocity(self, points: Array) -> Array:
        """(P, 3) [m/s] of material points (cvel is taken at the tree's centre of mass)."""
        world, data = self.world, self.world.data
        link = world.links[np.minimum((self._arc / self.rope.link_length).astype(int), self.rope.links - 1)]
        spatial = data.cvel[link]
        return spatial[:, 3:] + np.cross(spatial[:, :3], points - data.subtree_com[world.model.body_rootid[link]])

    def _build(self) -> World:
        rope = build_rope(self.rope, gripper=False)
        rope.spec.option.tolerance = TOLERANCE[self.config.mover]
        dress_spec(rope.spec)
        dress_rope(rope)
        rope.ground.contype = rope.ground.conaffinity = 1 | HAND
        add_slot(rope.spec, self.slot, 1 | HAND, 1 | HAND)
        self._mover.build(rope.spec)
        add_grasp(rope.spec, rope.links[0].name)
        world = World(rope)
        self._mover.bind(world.model)
        return world

    def _lay(self, start: Start) -> None:
        """Bend the free rope along the nodes of a start, its first link in the jaws."""
        ways = np.diff(start.nodes, axis=0)
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        data, model = self.world.data, self.world.model
        turned = matrix_of(tool_down(start.yaw)) @ TOOL_FROM_LINK
        root = int(model.body_jntadr[self.world.links[0]])
        at = int(model.jnt_qposadr[root])
        data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = start.gripper, quaternion_of_matrix(turned)
        for place, link in zip(self.world.joint_qpos, self.world.joint_link, strict=True):
            bent = turn_onto(-turned[:, 2], ways[link]) @ turned
            data.qpos[place : place + 4] = quaternion_of_matrix(turned.T @ bent)
            turned = bent


def _make_mover(config: CellConfig) -> Mover:
    if config.mover == "free":
        return FreeGripper()
    return Arm7(np.array([config.base_x, config.base_y, config.base_z]), config.base_yaw)

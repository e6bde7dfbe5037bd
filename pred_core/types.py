"""What the layers exchange. Frozen dataclasses; SI units; frame `world` (table, z up); `...` = any batch.

Measured things (`Tracks`, `Episode`, `CameraFrame`) are numpy; simulated things (`State`, `Grip`) are
float32 torch tensors, because networks and simulators read them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.config import setting
from pred_core.errors import DatasetError, InputError

Kind = Literal["line", "sheet", "volume", "mixed"]
KINDS: tuple[str, ...] = ("line", "sheet", "volume", "mixed")
Array = NDArray[np.float64]
STANDARD_GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2] world


@dataclass(frozen=True)
class CameraFrame:
    """One RGB-D picture."""

    stamp: int  # [ns] capture time
    rgb: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.float32]  # (H, W) [m], NaN = no measurement
    intrinsics: Array  # (3, 3) [px]
    world_from_camera: Array  # (4, 4) camera optical frame in world


@dataclass(frozen=True)
class Tracks:
    """Tracked particles of one instant, or of T instants with a leading axis T."""

    stamp: NDArray[np.int64]  # () or (T,) [ns] capture time
    position: Array  # (P, 3) or (T, P, 3) [m] world; NaN where not measured, or an estimate, not visible
    id: NDArray[np.uint32]  # (P,) persistent particle id
    visible: NDArray[np.bool_]  # (P,) or (T, P)
    confidence: NDArray[np.float32]  # (P,) or (T, P), 0 to 1
    color: NDArray[np.uint8] | None = None  # (P, 3) or (T, P, 3)


@dataclass(frozen=True)
class Sphere:
    """A fixed ball."""

    center: tuple[float, float, float]  # [m] world
    radius: float  # [m]


@dataclass(frozen=True)
class Capsule:
    """A fixed capsule."""

    start: tuple[float, float, float]  # [m] world
    end: tuple[float, float, float]  # [m] world
    radius: float  # [m]


@dataclass(frozen=True)
class Box:
    """A fixed box."""

    center: tuple[float, float, float]  # [m] world
    half_size: tuple[float, float, float]  # [m] along its own axes
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # wxyz world_from_box


Fixture = Sphere | Capsule | Box


@dataclass(frozen=True)
class Scene:
    """What surrounds the object."""

    gravity: tuple[float, float, float] = STANDARD_GRAVITY  # [m/s^2] world
    ground: float | None = None  # [m] height of the table plane, None = no table
    fixtures: tuple[Fixture, ...] = ()
    pusher_radius: float = 0.0  # [m] an open gripper pushes particles out of this sphere; 0 = it passes
    grasp_radius: float = 0.02  # [m] a gripper that closes takes the particles this near to its origin


@dataclass(frozen=True)
class Physics:
    """The identified scalars of the spring-mass model. Fields carry unit and search range.

    The first five are the paper's (III-A); `bending_stiffness` extends them and is off at 0.
    """

    stiffness: float = setting(100.0, unit="N", low=1e-1, high=1e5, log=True, doc="force per unit strain of a spring")
    damping: float = setting(0.05, unit="N s/m", low=1e-6, high=1e2, log=True, doc="dashpot along a spring")
    connection_threshold: float = setting(0.03, unit="m", low=1e-3, high=1.0, log=True, doc="longest spring made")
    max_springs: int = setting(20, unit="", low=1, high=64, doc="most springs at a particle")
    ground_friction: float = setting(0.5, unit="", low=0.0, high=3.0, doc="Coulomb coefficient at ground and fixtures")
    bending_stiffness: float = setting(
        0.0, unit="N m^2", low=0.0, high=10.0, log=True, floor=1e-6, doc="EI of bending by angle"
    )


@dataclass(frozen=True)
class Body:
    """The static object: particles, springs, bends. Scales multiply the scalars of `Physics`."""

    kind: str  # one of KINDS
    id: NDArray[np.uint32]  # (N,) the particle ids of the tracks it was built from
    rest_position: Array  # (N, 3) [m]
    mass: Array  # (N,) [kg]
    springs: NDArray[np.int32]  # (S, 2) particle indices, first < second
    rest_length: Array  # (S,) [m]
    stiffness_scale: Array  # (S,)
    damping_scale: Array  # (S,)
    friction_scale: Array  # (N,)
    surface: NDArray[np.bool_]  # (N,) measured from outside, not filled in
    region: NDArray[np.int32]  # (N,) material region
    bends: NDArray[np.int32]  # (B, 3) particle indices (before, at, after), ordered along a line
    bend_scale: Array  # (B,) multiplies bending_stiffness
    arc: Array  # (N,) material coordinate 0..1 (along a line; else normalised distance from particle 0)
    radius: float = 0.0  # [m] particle radius in contact

    @property
    def count(self) -> int:
        """Number of particles N."""
        return len(self.mass)


@dataclass(frozen=True)
class Grip:
    """Gripper poses at the end of a period; a plan or an episode adds a leading time axis."""

    position: Tensor  # (..., G, 3) [m] world
    rotation: Tensor  # (..., G, 4) wxyz, world_from_gripper
    closed: Tensor  # (..., G) bool

    def at(self, index: int) -> Grip:
        """The poses at one index of the leading axis."""
        return Grip(self.position[index], self.rotation[index], self.closed[index])

    def span(self, begin: int, end: int) -> Grip:
        """The poses begin..end-1 of the leading axis."""
        return Grip(self.position[begin:end], self.rotation[begin:end], self.closed[begin:end])


@dataclass(frozen=True)
class State:
    """The moving object. `memory` is read only by the Dynamics that wrote it; it forks with the state."""

    position: Tensor  # (..., N, 3) [m] world
    velocity: Tensor  # (..., N, 3) [m/s] world
    held: Tensor  # (..., N) int32 gripper index, -1 = free
    memory: Mapping[str, Tensor] = field(default_factory=dict)

    def replace(self, **changes: object) -> State:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class ObjectInfo:
    """What a data set says about its object."""

    name: str = setting("object", doc="name of the object")
    kind: str = setting("line", choices=KINDS, doc="geometry class")


@dataclass(frozen=True)
class Episode:
    """One recording window: tracks and gripper poses on a common clock."""

    name: str
    object: ObjectInfo
    stamps: NDArray[np.int64]  # (T,) [ns]
    tracks: Tracks  # leading axis T
    grips: Grip  # leading axis T
    held: NDArray[np.int32]  # (P,) gripper index at the first frame, -1 = free
    split: str  # train | test | ood
    recording: int  # episodes of one recording must not be split
    gravity: tuple[float, float, float] = STANDARD_GRAVITY
    cameras: tuple[str, ...] = ()  # topics prefixes of cameras in the bag
    source: Path | None = None

    @property
    def period(self) -> float:
        """Median time between frames [s]."""
        return float(np.median(np.diff(self.stamps))) * 1e-9

    @property
    def position(self) -> Array:
        """(T, P, 3) [m] world."""
        return self.tracks.position

    def state_at(self, frame: int) -> State:
        """Measured state at `frame` (>= 1): velocity by backward difference over one period.

        Raises: InputError if a particle is not measured at `frame` or the one before.
        """
        if not 1 <= frame < len(self.stamps):
            raise InputError(f"{self.name}: no start at frame {frame}", allowed=f"1 to {len(self.stamps) - 1}")
        now, before = self.position[frame], self.position[frame - 1]
        bad = ~np.isfinite(now + before).all(-1)
        if bad.any():
            ids = self.tracks.id[bad][:5].tolist()
            raise InputError(
                f"{self.name}: particles {ids} are not measured at frames {frame - 1} and {frame}",
                next_step="Start at a frame where every particle is seen",
            )
        dt = float(self.stamps[frame] - self.stamps[frame - 1]) * 1e-9
        return State(
            position=torch.as_tensor(now, dtype=torch.float32),
            velocity=torch.as_tensor((now - before) / dt, dtype=torch.float32),
            held=torch.as_tensor(self.held, dtype=torch.int32),
        )


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians bound to particles, for rendering."""

    mean: Tensor  # (M, 3) [m] world
    scale: Tensor  # (M, 3) [m]
    rotation: Tensor  # (M, 4) wxyz
    opacity: Tensor  # (M,) 0 to 1
    color: Tensor  # (M, 3) 0 to 1
    binding: Tensor  # (M, K) particle indices


def stack_states(states: list[State]) -> State:
    """Stack states along a new leading axis; memory is stacked key by key."""
    if not states:
        raise DatasetError("no states to stack", got="an empty list")
    return State(
        position=torch.stack([s.position for s in states]),
        velocity=torch.stack([s.velocity for s in states]),
        held=torch.stack([s.held for s in states]),
        memory={k: torch.stack([s.memory[k] for s in states]) for k in states[0].memory},
    )


def stack_grips(grips: list[Grip], dim: int = 0) -> Grip:
    """Stack gripper poses along a new axis `dim`."""
    return Grip(
        torch.stack([g.position for g in grips], dim),
        torch.stack([g.rotation for g in grips], dim),
        torch.stack([g.closed for g in grips], dim),
    )

"""What an effect is: one physical cause the base simulator lacks, with parameters whose null values switch it off.

Every hook returns something that is *added* (a force, a tension, a friction coefficient, a displacement), so
that null parameters reproduce the base simulator bit for bit. Physical hooks run inside the substeps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pred_core.effects.algebra import Vec3
from pred_core.errors import TwinError, nearest
from pred_core.twin import Extension
from pred_core.types import Array, Physics

HOOKS = ("boundary", "inertia", "spring", "bend", "rest_shape", "bend_stiffness", "contact", "force", "observe")


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect; `size` > 1 for a vector, whose components share unit and bounds."""

    name: str
    unit: str
    low: float
    high: float
    null: float = 0.0
    size: int = 1
    typical: float = 0.1  # how much of it matters: the first step of a search
    log: bool = False  # positive, searched on a log scale
    starts: tuple[float, ...] = ()  # refined, not searched globally: where a refinement starts, and what else it tries
    doc: str = ""
    # It matters only with another parameter on, and has many optima: values that a diagnosis tries first come from
    # "place": where the object was (world); "solid": the same, and behind where something seems to push, the switch, a
    # radius [m], as large as that is deep; "floor": a place's x and y; "arc": along the object; "direction": all round.
    scan: str = ""


@dataclass(frozen=True)
class ParticleContext:
    """What a `force` hook may read of one particle."""

    position: Vec3  # [m] world
    velocity: Vec3  # [m/s] world
    mass: Any  # [kg]
    arc: Any  # material coordinate 0..1
    time: Any  # [s] of the session: since the start, later by what `State.memory['time']` was set to
    tangent: Vec3 = Vec3(0.0, 0.0, 0.0)  # unit vector along a line, for effects that read it; 0 on sheets and volumes


@dataclass(frozen=True)
class SpringContext:
    """What a `spring` hook may read of one spring."""

    length: Any  # [m]
    rest_length: Any  # [m]
    rate: Any  # [m/s] growth of the length
    stiffness: Any  # [N] per unit strain, scales included
    damping: Any  # [N s/m], scales included
    arc: Any  # material coordinate of its middle, 0..1
    time: Any  # [s]


@dataclass(frozen=True)
class BendContext:
    """What a `bend` hook may read of one bend of a line: two edges that meet at a particle.

    Components are along two material axes that are fixed in the gripper and carried along the line.
    """

    curvature: tuple[Any, Any]  # components of the curvature binormal 2 tan(angle/2)
    change: tuple[Any, Any]  # their change since the last substep
    weight: Any  # [N m] bending stiffness / length
    length: Any  # [m] half of the two edges: curvature / length is the usual curvature [1/m]
    bends: Any  # number of bends of the line
    substep: Any  # [s]
    arc: Any  # material coordinate, 0..1
    time: Any  # [s]
    memory: tuple[Any, ...]  # `bend_memory` values this effect left here in the last substep; 0 at the start
    rest: tuple[Any, Any] = (0.0, 0.0)  # what other effects' `rest_shape` say, for effects that have one
    handed: tuple[Any, ...] = ()  # `line_values` this effect handed on at the bend before; 0 at a line's first
    arrived: tuple[Any, ...] = ()  # the same at the line's last bend, in the last substep; 0 at the start
    first_held: Any = 0.0  # 1 where a gripper holds the line's first edge, else 0
    last_held: Any = 0.0


@dataclass(frozen=True)
class ContactContext:
    """What a `contact` hook may read of one particle near the ground."""

    position: Vec3  # [m] world
    velocity: Vec3  # [m/s] world
    friction: Any  # coefficient, scales included
    time: Any  # [s]


@dataclass(frozen=True)
class GripContext:
    """What a `boundary` hook may read of one held particle."""

    position: Vec3  # [m] world, where the gripper says it is
    velocity: Vec3  # [m/s] world
    lever: Vec3  # [m] world, from the gripper's origin to the particle
    axes: tuple[Vec3, Vec3, Vec3]  # gripper axes in world
    time: Any  # [s]
    memory: tuple[Any, ...] = ()  # what `slide` keeps for this particle


@dataclass(frozen=True)
class SlideContext:
    """What a law of how a grip gives way may read. All that one gripper holds is one rigid piece."""

    pull: Vec3  # [N] world, on that piece: the rest of the object, gravity and `force` hooks; not contact
    mass: Any  # [kg] of that piece
    axes: tuple[Vec3, Vec3, Vec3]  # gripper axes in world
    substep: Any  # [s]
    time: Any  # [s]
    memory: tuple[Any, ...]  # `grip_memory` values of the last substep; 0 when the gripper closes


@dataclass(frozen=True)
class ObserveContext:
    """What an `observe` hook may read of one particle."""

    position: Vec3  # [m] world, where it truly is
    velocity: Vec3  # [m/s] world


class Effect:
    """Base class. A subclass declares the class attributes and overrides the hooks it names in `hooks`."""

    id: ClassVar[str]
    version: ClassVar[int] = 1
    family: ClassVar[str]
    hooks: ClassVar[tuple[str, ...]]
    parameters: ClassVar[tuple[Parameter, ...]]
    confounded_with: ClassVar[tuple[str, ...]] = ()
    bend_memory: ClassVar[int] = 0  # values a `bend` hook keeps per bend
    line_values: ClassVar[int] = 0  # values a `bend` hook hands on along a line, from bend to bend
    grip_memory: ClassVar[int] = 0  # values a `boundary` hook keeps per held particle, moved on by `slide`
    reads_tangent: ClassVar[bool] = False  # its `force` hook reads `ParticleContext.tangent`
    # Another effect whose `power` makes this law one of many: what a diagnosis checks the law's form by.
    form: ClassVar[str] = ""
    end_twist: ClassVar[str] = ""  # the parameter [rad] by which a line's far material axes are turned in its gripper

    headline: ClassVar[str] = ""  # the parameter that stands for the cause where one is shown; "": the first

    @classmethod
    def in_form(cls, p: Mapping[str, tuple[float, ...]], physics: Physics) -> dict[str, tuple[float, ...]]:
        """Parameters of the effect `form` that are the same law."""
        raise NotImplementedError(f"{cls.id} is of no form")

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        """Force added on a particle [N] world."""
        raise AttributeError(f"{cls.id} has no force hook")

    @classmethod
    def spring(cls, p: Mapping[str, Any], at: SpringContext) -> Any:
        """Tension added in a spring [N], positive pulls its ends together."""
        raise AttributeError(f"{cls.id} has no spring hook")

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        """(moment, moment) [N m] added along the two material axes; the new memory, then what is handed on."""
        raise AttributeError(f"{cls.id} has no bend hook")

    @classmethod
    def rest_shape(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any]:
        """Components of the curvature at which this effect's moment and the elastic one balance.

        Adds nothing by itself: it lets laws that change the rest shape see the elastic part of a curvature.
        """
        raise AttributeError(f"{cls.id} has no rest_shape hook")

    @classmethod
    def bend_stiffness(cls, p: Mapping[str, Any], arc: Any, time: Any) -> Any:
        """Relative bending stiffness added, EI (1 + this), at material coordinate `arc` and `time` [s]."""
        raise AttributeError(f"{cls.id} has no bend_stiffness hook")

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        """(relative stiffness, damping time [s]) a `bend` hook adds to the weight at most; for the choice of substeps.

        `length` (B,) [m] is what `BendContext` says of each bend.
        A `bend` hook's stiffness may be given as what a straight bend would need to be as stiff up to 90 degrees.
        """
        return 0.0, 0.0

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        """Rate [1/s] at most at which a `force` hook takes a free particle's speed; for the choice of substeps."""
        return 0.0

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        """(friction coefficient added, ground height added [m])."""
        raise AttributeError(f"{cls.id} has no contact hook")

    @classmethod
    def boundary(cls, p: Mapping[str, Any], at: GripContext) -> Vec3:
        """Displacement of a held particle's target [m] world."""
        raise AttributeError(f"{cls.id} has no boundary hook")

    @classmethod
    def slide(cls, p: Mapping[str, Any], at: SlideContext) -> tuple[Any, ...]:
        """The new memory, once a substep for each held particle; then `boundary` places the particle by it."""
        raise AttributeError(f"{cls.id} keeps no memory of its grip")

    @classmethod
    def inertia(cls, p: Mapping[str, Any], arc: Any) -> Any:
        """Relative mass added, (1 + this) * mass, at material coordinate `arc`."""
        raise AttributeError(f"{cls.id} has no inertia hook")

    @classmethod
    def observe(cls, p: Mapping[str, Any], at: ObserveContext) -> Vec3:
        """Displacement of a reported point from the true one [m] world. Corrected where data enter, never simulated."""
        raise AttributeError(f"{cls.id} has no observe hook")

    @classmethod
    def null(cls) -> dict[str, tuple[float, ...]]:
        """The parameter values that switch the effect off."""
        return {q.name: (q.null,) * q.size for q in cls.parameters}

    @classmethod
    def extension(cls, **values: float | tuple[float, ...]) -> Extension:
        """An `Extension` entry with these values; parameters and last components not given are null."""
        merged = cls.null()
        for name, value in values.items():
            if name not in merged:
                raise TwinError(f"effect '{cls.id}' has no parameter '{name}'", next_step=nearest(name, merged))
            given = tuple(np.atleast_1d(np.asarray(value, dtype=float)).tolist())
            if len(given) > len(merged[name]):
                raise TwinError(f"effect '{cls.id}': '{name}'", got=f"{len(given)} values",
                                allowed=f"at most {len(merged[name])}")  # fmt: skip
            merged[name] = given + merged[name][len(given) :]
        return Extension(cls.id, cls.version, merged)

    @classmethod
    def check(cls, extension: Extension) -> None:
        """Raise TwinError unless the values fit the declaration: version, names, exactly `size` numbers, bounds."""
        where = f"{extension.source}: " if extension.source else ""
        what = f"{where}effect '{cls.id}'"
        if extension.version != cls.version:
            raise TwinError(f"{what}: version", got=extension.version, allowed=cls.version)
        known = {q.name: q for q in cls.parameters}
        for name in extension.parameters:
            if name not in known:
                raise TwinError(f"{what} has no parameter '{name}'", next_step=nearest(name, known))
        for name, q in known.items():
            values = extension.parameters.get(name)
            numbers = isinstance(values, tuple) and all(type(v) in (int, float) for v in values)
            if values is None or not numbers or len(values) != q.size:
                raise TwinError(f"{what}: '{name}'", got=values, allowed=f"{q.size} value(s) [{q.unit}]")
            for value in values:
                if not (np.isfinite(value) and (value == q.null or q.low <= value <= q.high)):
                    raise TwinError(f"{what}: '{name}'", got=value, allowed=f"{q.low} to {q.high} {q.unit}")

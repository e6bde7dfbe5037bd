"""What is searched: scalars of `Physics` and parameters of effects, in coordinates of comparable size.

A coordinate z moves a parameter by its typical amount: value = start + z scale, or start exp(z scale) for one
searched on a log scale. Bounds are those the parameter itself declares.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pred_core.effects import find_effect
from pred_core.errors import ConfigError, nearest
from pred_core.twin import Extension
from pred_core.types import Array, Physics

WIDEST_VECTOR = 3  # components; a longer parameter is a profile
LOG_STEPS = 6.0  # PhysTwin's choice: a first step is a sixth of the range
DISCRETE = ("connection_threshold", "max_springs")  # steps, not slopes: not for a local refinement


@dataclass(frozen=True)
class Knob:
    """One searched number. `name` is a field of Physics, or `effect.parameter[k]`."""

    name: str
    unit: str
    low: float
    high: float
    log: bool
    start: float
    scale: float
    profile: bool = False  # a coefficient of a profile, or an angle with many optima: refined, not searched globally
    starts: tuple[float, ...] = ()  # where a refinement starts if the parameter is off; the others are tried too
    null: float = 0.0  # the value that is off

    def value(self, z: float) -> float:
        """The parameter's value, inside its bounds."""
        raw = self.start * math.exp(min(z * self.scale, 700.0)) if self.log else self.start + z * self.scale
        return min(max(raw, self.low), self.high)

    def coordinate(self, value: float) -> float:
        """The inverse of `value`."""
        if self.log:
            return math.log(max(value, self.low) / self.start) / self.scale
        return (value - self.start) / self.scale

    def at_bound(self, value: float) -> bool:
        """Whether a value sits on a bound, to a thousandth of the range."""
        z, low, high = (self.coordinate(v) for v in (value, self.low, self.high))
        return bool(min(z - low, high - z) < 1e-3 * (high - low))


@dataclass(frozen=True)
class Candidate:
    """One point of the search as the simulator takes it."""

    physics: Physics
    extensions: tuple[Extension, ...]


@dataclass(frozen=True)
class SearchSpace:
    """The knobs, and the values of everything that is not searched."""

    knobs: tuple[Knob, ...]
    physics: Physics
    extensions: tuple[Extension, ...] = ()

    def coarse(self) -> SearchSpace:
        """What a global search moves: no profiles; parameters that are only refined act at their first start."""
        extensions = []
        for e in self.extensions:
            values = {name: list(v) for name, v in e.parameters.items()}
            for knob in self.knobs:
                effect, _, rest = knob.name.partition(".")
                if effect == e.id and knob.starts and knob.start == knob.null:
                    parameter, index = rest[:-1].split("[")
                    values[parameter][int(index)] = knob.starts[0]
            extensions.append(dataclasses.replace(e, parameters={k: tuple(v) for k, v in values.items()}))
        return SearchSpace(tuple(k for k in self.knobs if not k.profile), self.physics, tuple(extensions))

    def bounds(self) -> tuple[list[float], list[float]]:
        """(lower, upper) coordinates."""
        return [k.coordinate(k.low) for k in self.knobs], [k.coordinate(k.high) for k in self.knobs]

    def start(self) -> Array:
        """The coordinates of the present values (zeros)."""
        return np.zeros(len(self.knobs))

    def candidate(self, z: Sequence[float] | Array) -> Candidate:
        """The point at coordinates z."""
        physics: dict[str, Any] = dataclasses.asdict(self.physics)
        extensions = {e.id: {k: list(v) for k, v in e.parameters.items()} for e in self.extensions}
        for knob, coordinate in zip(self.knobs, z, strict=True):
            value = knob.value(float(coordinate))
            if "." in knob.name:
                effect, parameter, index = _address(knob.name)
                extensions[effect][parameter][index] = value
            else:
                physics[knob.name] = round(value) if isinstance(physics[knob.name], int) else value
        return Candidate(
            Physics(**physics),
            tuple(
                dataclasses.replace(e, parameters={k: tuple(v) for k, v in extensions[e.id].items()})
                for e in self.extensions
            ),
        )

    def values(self, z: Sequence[float] | Array) -> dict[str, float]:
        """Knob name to value at z."""
        return {k.name: k.value(float(c)) for k, c in zip(self.knobs, z, strict=True)}

    def at(self, candidate: Candidate) -> SearchSpace:
        """The same knobs with their zero moved to `candidate`."""
        knobs = tuple(_moved(k, candidate) for k in self.knobs)
        return SearchSpace(knobs, candidate.physics, candidate.extensions)


def search_space(
    physics: Physics, names: Sequence[str], effects: Sequence[str] = (), extensions: Sequence[Extension] = ()
) -> SearchSpace:
    """Knobs for the named Physics fields and for every parameter of the named effects.

    Effects not among `extensions` start at their null values. Raises: ConfigError for an unknown or repeated name,
    TwinError for an unknown effect.
    """
    fields = {f.name: f for f in dataclasses.fields(Physics)}
    knobs = []
    for name in [*names, *effects]:
        if [*names, *effects].count(name) > 1:
            raise ConfigError(f"'{name}' is given twice", allowed="each parameter and effect once")
    for name in names:
        if name not in fields:
            raise ConfigError(f"unknown parameter '{name}'", next_step=nearest(name, fields))
        knobs.append(_physics_knob(fields[name], getattr(physics, name)))
    present = {e.id: e for e in extensions}
    for id in effects:
        effect = find_effect(id)
        present.setdefault(id, effect.extension())
        for q in effect.parameters:
            for k in range(q.size):
                value = present[id].parameters[q.name][k]
                start = max(value, q.low) if q.log else value
                profile = q.size > WIDEST_VECTOR or bool(q.starts)
                name = f"{id}.{q.name}[{k}]"
                knobs.append(Knob(name, q.unit, q.low, q.high, q.log, start, q.typical, profile, q.starts, q.null))
    return SearchSpace(tuple(knobs), physics, tuple(present.values()))


def _physics_knob(field: dataclasses.Field[Any], value: float) -> Knob:
    m = field.metadata
    low = m["low"] if m["floor"] is None else m["floor"]
    if m["log"]:
        start = min(max(float(value), low), m["high"])
        return Knob(field.name, m["unit"], low, m["high"], True, start, math.log(m["high"] / low) / LOG_STEPS)
    return Knob(field.name, m["unit"], low, m["high"], False, float(value), (m["high"] - low) / LOG_STEPS)


def _moved(knob: Knob, candidate: Candidate) -> Knob:
    if "." not in knob.name:
        value = float(getattr(candidate.physics, knob.name))
    else:
        effect, parameter, index = _address(knob.name)
        value = next(e for e in candidate.extensions if e.id == effect).parameters[parameter][index]
    # A logarithmic knob cannot start at zero.
    return dataclasses.replace(knob, start=max(value, knob.low) if knob.log else value)


def _address(name: str) -> tuple[str, str, int]:
    """`effect.parameter[k]` as (effect, parameter, k)."""
    effect, rest = name.split(".", 1)
    parameter, index = rest[:-1].split("[")
    return effect, parameter, int(index)

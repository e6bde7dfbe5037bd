"""What each world is made of: its Physics and extensions as rows of numbers for the kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pred_core.effects import effect_of
from pred_core.effects.effect import Effect
from pred_core.errors import ConfigError
from pred_core.springmass.stability import Added
from pred_core.springmass.topology import bend_lengths
from pred_core.twin import Extension
from pred_core.types import Body, Physics

PerWorld = list[tuple[Extension, ...]]
SESSION = 300.0  # [s] of the session up to which the choice of substeps foresees a drift


def extensions_per_world(extensions: Sequence[Extension] | Sequence[Sequence[Extension]], worlds: int) -> PerWorld:
    """One tuple for all worlds, or one per world. Raises: ConfigError if their number is not that of Physics."""
    lists: PerWorld = []
    for entry in extensions:
        if not isinstance(entry, Extension):
            lists.append(tuple(entry))
    if not lists:
        return [tuple(e for e in extensions if isinstance(e, Extension))]
    if len(lists) != len(extensions) or worlds not in (1, len(lists)):
        raise ConfigError("extensions per world", got=len(lists), allowed=f"{worlds}, as Physics")
    return lists


def effects_of(per_world: PerWorld) -> tuple[type[Effect], ...]:
    """The effects every world has. Raises: ConfigError if they differ, TwinError if a value is out of bounds."""
    ids = [[e.id for e in extensions] for extensions in per_world]
    if any(i != ids[0] for i in ids) or len(set(ids[0])) != len(ids[0]):
        raise ConfigError("extensions", got=ids[0], allowed="the same effects in every world, each once")
    found = [tuple(effect_of(e) for e in extensions) for extensions in per_world]
    return found[0]


def added_by(body: Body, extensions: Sequence[Extension]) -> Added:
    """What these effects add to the body at most, for the choice of substeps.

    As in the kernel: `bend_stiffness` hooks scale the weight EI/lbar, `bend` hooks multiply what they return by it.
    Where the scale changes with time, the larger of those at the session's begin and after `SESSION` counts.
    """
    arc, length = torch.as_tensor(body.arc[body.bends[:, 1]]), bend_lengths(body)
    scale = torch.ones(2, len(arc), dtype=arc.dtype)
    times = torch.tensor([[0.0], [SESSION]], dtype=arc.dtype)
    stiffness, time, rate = 0.0, 0.0, 0.0
    for extension in extensions:
        effect = effect_of(extension)
        if "bend_stiffness" in effect.hooks:
            scale = scale + effect.bend_stiffness(extension.parameters, arc, times)
        more, seconds = effect.bend_bound(extension.parameters, length)
        stiffness += more
        time += seconds
        rate += effect.rate_bound(extension.parameters)
    return Added(scale.amax(0).numpy(), stiffness, time, rate)


def parameter_rows(physics: list[Physics], per_world: PerWorld, effects: tuple[type[Effect], ...]) -> Tensor:
    """(W, Q) float32: base parameters, then each effect's in declared order."""
    rows = []
    for w in range(max(len(physics), len(per_world))):
        p = physics[w % len(physics)]
        row = [p.stiffness, p.damping, p.ground_friction, p.bending_stiffness]
        for effect, extension in zip(effects, per_world[w % len(per_world)], strict=True):
            row += [v for q in effect.parameters for v in extension.parameters[q.name]]
        rows.append(row)
    return torch.tensor(rows, dtype=torch.float32)

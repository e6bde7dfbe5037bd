"""How much the data say about each parameter."""

from __future__ import annotations

import numpy as np

from pred_core.identify.problem import Problem
from pred_core.identify.search import trimmed
from pred_core.identify.space import DISCRETE, Knob, SearchSpace
from pred_core.types import Array

CHANGE = 0.1  # relative for a logarithmic knob, of the typical size for the others
FLOOR = 1e-3  # a loss that changes by less does not show the parameter


def sensitivities(problem: Problem, space: SearchSpace) -> list[float]:
    """Relative change of the loss when a knob moves 10 % up or down, the larger of the two in size.

    Near zero: the data do not show this parameter. What makes springs moves on until other springs are made, so the
    problem must know its topology; a knob that cannot change them has zero.
    """
    points, owner = [], []
    for n in range(len(space.knobs)):
        for sign in (-1.0, 1.0):
            z = _moved(problem, space, n, sign)
            if z is not None:
                points.append(z)
                owner.append(n)
    candidates = [space.candidate(z) for z in (space.start(), *points)]
    substeps = min(max(problem.substeps(c) for c in candidates), problem.most_substeps)
    losses = trimmed(problem.losses(candidates, substeps))
    growth = np.abs(losses[1:] / max(float(losses[0]), 1e-12) - 1.0)
    return [max((float(g) for g, o in zip(growth, owner, strict=True) if o == n), default=0.0)
            for n in range(len(space.knobs))]  # fmt: skip


def _moved(problem: Problem, space: SearchSpace, index: int, sign: float) -> Array | None:
    """The zero of `space` with one knob moved; None if it cannot move."""
    knob = space.knobs[index]
    z = space.start()
    if knob.name not in DISCRETE:
        z[index] = sign * knob_step(knob)
        return z
    topology = problem.topology
    if topology is None:
        return None
    here = topology.chosen(space.candidate(z).physics)
    for _ in range(64):
        value = knob.value(float(z[index]))
        wanted = value + sign if knob.name == "max_springs" else value * np.exp(sign * np.log1p(CHANGE))
        if not knob.low <= wanted <= knob.high:
            return None
        z[index] = knob.coordinate(wanted)
        physics = space.candidate(z).physics
        if (topology.chosen(physics) != here).any():
            return None if topology.loose(physics) else z
    return None


def knob_step(knob: Knob) -> float:
    """A change of `CHANGE` in coordinates."""
    return float(np.log1p(CHANGE)) / knob.scale if knob.log else CHANGE

"""How much the data say about each parameter."""

from __future__ import annotations

import numpy as np

from pred_core.identify.problem import Problem
from pred_core.identify.search import trimmed
from pred_core.identify.space import SearchSpace

CHANGE = 0.1  # relative for a logarithmic knob, of the typical size for the others


def sensitivities(problem: Problem, space: SearchSpace) -> list[float]:
    """Relative growth of the loss when a knob moves 10 %, the smaller of up and down.

    Near zero: the data do not show this parameter. Negative: the optimum of these windows lies elsewhere.
    """
    steps = [np.log1p(CHANGE) / k.scale if k.log else CHANGE for k in space.knobs]
    points = [space.start()]
    for n, step in enumerate(steps):
        for sign in (-1.0, 1.0):
            z = space.start()
            z[n] = sign * step
            points.append(z)
    losses = trimmed(problem.losses([space.candidate(z) for z in points]))
    growth = losses[1:].reshape(-1, 2) / losses[0] - 1.0
    return [float(g) for g in growth.min(axis=1)]

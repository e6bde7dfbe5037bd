"""Local 95 % intervals of single parameters, from how the loss itself bends about the optimum.

A sandwich estimator of one parameter at a time, the others fixed, whose clusters are recordings: the slopes g_c of the
recordings' losses scatter, the curvature H of their sum holds the optimum in place,
var = C/(C-1) sum (g_c - mean g)^2 / H^2. Differences are taken over a change of 10 %, not over an infinitesimal one:
rollouts can be chaotic, and small steps would show slopes that hold nowhere.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from pred_core.identify.problem import Problem
from pred_core.identify.refine import OUTLIER
from pred_core.identify.sensitivity import knob_step
from pred_core.identify.space import SearchSpace

LEVEL = 0.95


def half_widths(problem: Problem, space: SearchSpace) -> list[float | None]:
    """Half width of each knob's interval in coordinates, about the zero of `space`.

    None where there is no telling: a single recording, a value within 10 % of its bound, or a loss that does not rise
    to both sides. Student's t with (recordings - 1) degrees of freedom, because recordings are few.
    """
    lower, upper = (np.array(b) for b in space.bounds())
    steps = np.array([knob_step(k) for k in space.knobs])
    axes = np.diag(steps)
    candidates = [space.candidate(z) for z in (space.start(), *axes, *-axes)]
    substeps = min(max(problem.substeps(c) for c in candidates), problem.most_substeps)
    losses = problem.losses(candidates, substeps)
    keep = losses[0] <= OUTLIER * np.median(losses[0])
    member = np.array(problem.windows.groups)[keep]
    clusters = sorted(set(member.tolist()))
    if len(clusters) < 2:
        return [None] * len(space.knobs)
    sums = np.stack([losses[:, keep][:, member == c].sum(axis=1) for c in clusters], axis=1)  # (1 + 2D, C)
    here, up, down = sums[0], sums[1 : 1 + len(steps)], sums[1 + len(steps) :]
    slope = (up - down) / (2.0 * steps[:, None])
    curvature = (up + down - 2.0 * here).sum(axis=1) / steps**2
    scatter = ((slope - slope.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) * len(clusters) / (len(clusters) - 1)
    factor = float(student.ppf(0.5 + LEVEL / 2, len(clusters) - 1))
    known = (curvature > 0.0) & (steps <= upper) & (-steps >= lower)
    return [factor * float(np.sqrt(s)) / float(c) if k else None
            for s, c, k in zip(scatter, curvature, known, strict=True)]  # fmt: skip

"""Local 95 % intervals: a sandwich estimator whose clusters are recordings.

H^-1 (sum over clusters of g g') H^-1, with central differences. Rollouts can be chaotic: a window whose slopes up
and down differ by more than their sum is no longer smooth over the step and counts as saying nothing.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from pred_core.identify.problem import Problem
from pred_core.identify.refine import SOFTNESS, kept
from pred_core.identify.space import SearchSpace

LEVEL = 0.95
STEP = 0.01  # finite difference, in coordinates: 2 % of a stiffness


def half_widths(problem: Problem, space: SearchSpace, stride: int) -> list[float | None]:
    """Half width of each knob's interval in coordinates, about the zero of `space`.

    None where there is no telling: a single recording, a value at its bound, or no window that is smooth in it.
    Student's t with (recordings - 1) degrees of freedom, because recordings are few.
    """
    groups = sorted(set(problem.windows.groups))
    lower, upper = (np.array(b) for b in space.bounds())
    up, down = np.minimum(STEP, upper), np.minimum(STEP, -lower)
    inside = np.minimum(up, down) > 0.1 * STEP
    wanted = np.flatnonzero(inside)
    nothing: list[float | None] = [None] * len(space.knobs)
    if len(groups) < 2 or not len(wanted):
        return nothing
    axes = np.eye(len(space.knobs))
    points = [space.start(), *(up[d] * axes[d] for d in wanted), *(-down[d] * axes[d] for d in wanted)]
    candidates = [space.candidate(p) for p in points]
    substeps = min(max(problem.substeps(c) for c in candidates), problem.most_substeps)
    rolled = problem.residuals(candidates, stride, substeps)
    keep, _ = kept(rolled[0])
    now, rolled = rolled[0][keep], rolled[1:][:, keep]
    rises = (rolled[: len(wanted)] - now) / up[wanted].astype(np.float32)[:, None, None]
    falls = (now - rolled[len(wanted) :]) / down[wanted].astype(np.float32)[:, None, None]
    smooth = np.abs(rises - falls).sum(axis=2) <= np.abs(rises + falls).sum(axis=2)
    jacobian = np.where(smooth[..., None], 0.5 * (rises + falls), np.float32(0.0))
    weight = 1.0 / np.sqrt(now**2 + np.float32(SOFTNESS**2))
    scores = np.einsum("dwr,wr->wd", jacobian, weight * now).astype(np.float64)
    hessian = np.einsum("dwr,ewr->de", jacobian * weight[None], jacobian).astype(np.float64)
    member = np.array(problem.windows.groups)[keep]
    sums = np.stack([scores[member == g].sum(axis=0) for g in sorted(set(member.tolist()))])
    if len(sums) < 2:
        return nothing
    sums -= sums.mean(axis=0)
    meat = sums.T @ sums * len(sums) / (len(sums) - 1)
    inverse = np.linalg.pinv(hessian, rcond=1e-10)
    variance = np.diag(inverse @ meat @ inverse)
    factor = float(student.ppf(0.5 + LEVEL / 2, len(sums) - 1))
    widths = nothing.copy()
    for n, d in enumerate(wanted.tolist()):
        if hessian[n, n] > 0.0:
            widths[d] = factor * float(np.sqrt(max(variance[n], 0.0)))
    return widths

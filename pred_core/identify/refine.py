"""Local refinement: Levenberg-Marquardt on robust residuals, the whole Jacobian as one batch of worlds.

Minimises the mean absolute error by iteratively reweighted least squares, w = 1/sqrt(r^2 + e^2), over the windows
that are not outliers (loss above twice the median: a rule that looks at the fitted windows only). Short windows first:
long rollouts have local optima.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.identify.problem import Problem
from pred_core.identify.space import SearchSpace
from pred_core.types import Array

STEP = 0.05  # finite difference, in coordinates (twentieths of a typical change)
LOG_STEP = 0.03  # finite difference of a logarithm at most
SOFTNESS = 0.003  # [m] below which an error counts quadratically
OUTLIER = 2.0  # times the median loss
RIDGE = 1e-7  # of the mean curvature; 1e-4 froze profiles of a soft cable
LONGEST_STEP = 3.0  # in coordinates, per iteration
PATIENCE = 7  # times the damping is raised before giving up
IMPROVEMENT = 5e-4  # relative, below which it has converged
Report = Callable[[int, int, float], None]  # iteration, planned, loss [m]
Residuals = NDArray[np.float32]


@dataclass(frozen=True)
class Refined:
    """The end of a refinement."""

    z: Array
    loss: float  # [m] mean absolute error of the windows kept
    left_out: tuple[str, ...]  # episodes at least half of whose windows were outliers


def refine(
    problem: Problem, space: SearchSpace, z: Array, iterations: int, stride: int, report: Report, shrink: float = 0.0
) -> Refined:
    """The local optimum near z.

    `shrink` [m]: the loss gains shrink/2 for every profile value that is a typical change away from off, squared;
    without it the many values of a profile fit the noise and the damage of the recordings.
    """
    lower, upper = (np.array(b) for b in space.bounds())
    z = np.clip(np.asarray(z, dtype=np.float64), lower, upper)
    width = np.array([min(STEP, LOG_STEP / k.scale) if k.log else STEP for k in space.knobs])
    pull = np.array([shrink if k.profile and not k.starts else 0.0 for k in space.knobs])
    off = np.array([k.coordinate(k.null) if p else 0.0 for k, p in zip(space.knobs, pull, strict=True)])
    damping, loss, keep = 1e-2, np.inf, np.ones(problem.windows.count, dtype=bool)
    for iteration in range(iterations):
        # One-sided differences that stay inside the bounds; all points with the same substeps, or their differences
        # would show the integrator's error.
        step = np.where(z + width <= upper, width, -width)
        points = [z, *(z + step[d] * np.eye(len(z))[d] for d in range(len(z)))]
        candidates = [space.candidate(p) for p in points]
        substeps = min(max(problem.substeps(c) for c in candidates), problem.most_substeps)
        rolled = problem.residuals(candidates, stride, substeps)
        keep, misfit = kept(rolled[0])
        report(iteration, iterations, misfit)
        loss = misfit + 0.5 * float(pull @ (z - off) ** 2)
        now = rolled[0][keep]
        # A start of chaos is not a slope: no parameter moves a particle a metre per coordinate.
        jacobian = np.clip((rolled[1:][:, keep] - now) / step.astype(np.float32)[:, None, None], -1.0, 1.0)
        normal, slope = _normal_equations(jacobian, now)
        normal, slope = normal + np.diag(pull), slope + pull * (z - off)
        for _ in range(PATIENCE):
            move = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(z)), slope)
            trial = np.clip(z + np.clip(move, -LONGEST_STEP, LONGEST_STEP), lower, upper)
            candidate = space.candidate(trial)
            finer = max(substeps, min(problem.substeps(candidate), problem.most_substeps))
            better = float(np.abs(problem.residuals([candidate], stride, finer)[0][keep]).mean())
            better += 0.5 * float(pull @ (trial - off) ** 2)
            if better < loss:
                break
            damping *= 6.0
        else:
            break
        z, before, loss, damping = trial, loss, better, max(damping / 5.0, 1e-6)
        if before - better < IMPROVEMENT * before:
            break
    report(iterations, iterations, loss)
    return Refined(z, loss, _damaged(problem.windows.names, keep))


def _damaged(names: tuple[str, ...], keep: NDArray[np.bool_]) -> tuple[str, ...]:
    """Episodes with at least half of their windows left out."""
    left: dict[str, list[bool]] = {}
    for name, k in zip(names, keep.tolist(), strict=True):
        left.setdefault(name, []).append(not k)
    return tuple(n for n, v in left.items() if 2 * sum(v) >= len(v))


def kept(residual: Residuals) -> tuple[NDArray[np.bool_], float]:
    """(windows of (W, R) that are no outliers, their mean absolute error [m] over all entries)."""
    size = np.abs(residual).mean(axis=1)
    keep = size <= OUTLIER * np.median(size)
    return keep, float(size[keep].mean())


def _normal_equations(jacobian: Residuals, now: Residuals) -> tuple[Array, Array]:
    """(J' W J, J' W r) a residual, of J (D, W, R) and r (W, R), with a floor under flat directions."""
    flat = jacobian.reshape(len(jacobian), -1)
    r = now.reshape(-1)
    weighted = flat / np.sqrt(r**2 + np.float32(SOFTNESS**2))
    normal = (weighted @ flat.T).astype(np.float64) / len(r)
    # Directions that move nothing stay where they are: a floor far below what the data say of any useful one.
    normal += RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    return normal, (weighted @ r).astype(np.float64) / len(r)

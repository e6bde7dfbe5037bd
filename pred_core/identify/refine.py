"""Local refinement: Levenberg-Marquardt on robust residuals, the whole Jacobian as one batch of worlds.

Minimises the mean absolute error by iteratively reweighted least squares, w = 1/sqrt(r^2 + e^2), over the windows
that are not outliers (loss above twice the median: a rule that looks at the fitted windows only). Short windows first:
long rollouts have local optima.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pred_core.identify.problem import Problem
from pred_core.identify.space import SearchSpace
from pred_core.types import Array

STEP = 0.05  # finite difference, in coordinates (twentieths of a typical change)
SOFTNESS = 0.003  # [m] below which an error counts quadratically
OUTLIER = 2.0  # times the median loss
RIDGE = 1e-4  # of the mean curvature
LONGEST_STEP = 3.0  # in coordinates, per iteration
PATIENCE = 7  # times the damping is raised before giving up
IMPROVEMENT = 5e-4  # relative, below which it has converged
Report = Callable[[int, int, float], None]


@dataclass(frozen=True)
class Refined:
    """The end of a refinement."""

    z: Array
    loss: float  # [m] mean absolute error of the windows kept
    left_out: tuple[str, ...]  # windows that were outliers
    covariance: Array  # (D, D) of z, cluster-robust over windows


def refine(problem: Problem, space: SearchSpace, z: Array, iterations: int, stride: int, report: Report) -> Refined:
    """The local optimum near z."""
    lower, upper = (np.array(b) for b in space.bounds())
    z = np.clip(np.asarray(z, dtype=np.float64), lower, upper)

    def residuals(points: list[Array]) -> Array:
        return problem.residuals([space.candidate(p) for p in points], stride)

    now = residuals([z])[0]
    damping = 1e-2
    for iteration in range(iterations):
        keep, loss = _kept(now)
        report(iteration, iterations, loss)
        normal, slope = _normal_equations(residuals, z, now, keep, lower, upper)
        for _ in range(PATIENCE):
            move = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(z)), slope)
            trial = np.clip(z + np.clip(move, -LONGEST_STEP, LONGEST_STEP), lower, upper)
            after = residuals([trial])[0]
            better = float(np.abs(after[keep]).mean())
            if better < loss:
                break
            damping *= 6.0
        else:
            break
        z, now, damping = trial, after, max(damping / 5.0, 1e-6)
        if loss - better < IMPROVEMENT * loss:
            break
    keep, loss = _kept(now)
    report(iterations, iterations, loss)
    left_out = tuple(n for n, k in zip(problem.windows.names, keep, strict=True) if not k)
    return Refined(z, loss, left_out, _covariance(residuals, z, now, keep, lower, upper))


def _kept(residual: Array) -> tuple[Array, float]:
    """(windows that are no outliers, their mean absolute error over all entries)."""
    size = np.abs(residual).mean(axis=1)
    keep = size <= OUTLIER * np.median(size)
    return keep, float(size[keep].mean())


def _jacobian(
    residuals: Callable[[list[Array]], Array], z: Array, now: Array, keep: Array, lower: Array, upper: Array
) -> Array:
    """(D, W kept, R) by one-sided differences that stay inside the bounds."""
    sign = np.where(z + STEP <= upper, 1.0, -1.0)
    sign = np.where(z + sign * STEP < lower, 0.5 * sign, sign)
    moved = [z + sign[d] * STEP * np.eye(len(z))[d] for d in range(len(z))]
    rows = (residuals(moved)[:, keep] - now[keep]) / (sign * STEP).astype(np.float32)[:, None, None]
    # A start of chaos is not a slope: no parameter moves a particle a metre per coordinate.
    return np.clip(rows, -1.0, 1.0)


def _normal_equations(
    residuals: Callable[[list[Array]], Array], z: Array, now: Array, keep: Array, lower: Array, upper: Array
) -> tuple[Array, Array]:
    jacobian = _jacobian(residuals, z, now, keep, lower, upper).reshape(len(z), -1)
    r = now[keep].reshape(-1)
    weighted = jacobian / np.sqrt(r**2 + SOFTNESS**2)
    normal = (weighted @ jacobian.T).astype(np.float64) / len(r)
    # Directions that move nothing stay where they are: a floor far below what the data say of any useful one.
    normal += RIDGE * np.trace(normal) / len(z) * np.eye(len(z))
    return normal, (weighted @ r).astype(np.float64) / len(r)


def _covariance(
    residuals: Callable[[list[Array]], Array], z: Array, now: Array, keep: Array, lower: Array, upper: Array
) -> Array:
    """Sandwich estimator with windows as clusters: H^-1 (sum g g') H^-1."""
    jacobian = _jacobian(residuals, z, now, keep, lower, upper)
    r = now[keep]
    weight = 1.0 / np.sqrt(r**2 + SOFTNESS**2)
    scores = np.einsum("dwr,wr->wd", jacobian, weight * r).astype(np.float64)
    hessian = np.einsum("dwr,ewr->de", jacobian * weight[None], jacobian).astype(np.float64)
    inverse = np.linalg.pinv(hessian, rcond=1e-10)
    return inverse @ (scores.T @ scores) @ inverse

"""Fitting a candidate's parameters to a sample: robust Levenberg-Marquardt on weighted residuals.

The loss of a window is the mean of rho(u) = sqrt(1 + u^2) - 1 over its frames, seen particles and coordinates, u the
residual in standard deviations (`weigh`); of an episode the mean over its windows of c log(1 + loss / c), c the usual
loss of a window as things stand. So a window in which the object goes another way altogether (a rope that whips, or
sticks a moment longer) counts like a few others, and decides neither what a parameter is nor whether there is a cause.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.diagnose.roll import MOST_FACTOR, Roller
from pred_core.diagnose.weigh import Weights, seen_of
from pred_core.identify.space import SearchSpace
from pred_core.types import Array

USUAL = 1.0  # loss of a window from which it counts less, at least: noise and what engines differ by leave 0.4 to 0.6
IN_FULL = 1e9  # a usual loss beyond any
STEP = 0.05  # of a difference, in coordinates (typical changes)
LONGEST = 2.0  # coordinates a step; twice as many after each step that was cut and helped
CUT = 1.0 - 1e-9  # of the longest step, from which one counts as cut: rounding may take the rest
PATIENCE = 5  # times the damping is raised before giving up
CONVERGED = 2e-4  # relative change of the loss
STIFFENS = 1.002  # times the substeps needed: a coordinate that raises them by more presses on their limit
PARTS = (0.5, 0.25, 0.125, 0.0)  # of its step that such a coordinate may still go
PRIOR = 1e-4  # pull of a coordinate towards its start, a typical change squared, as a loss: breaks ties


@dataclass(frozen=True)
class Fit:
    """Where a fit ended, and what cross-fitting needs."""

    z: Array  # (P,) coordinates
    loss: Array  # (E,) per episode
    gradient: Array  # (E, P) of each episode's loss times E / E: they average to the whole's
    curvature: Array  # (E, P, P)


@dataclass(frozen=True)
class Target:
    """A sample with its weights."""

    roller: Roller
    weights: Weights  # (W, K, N)
    stride: int
    usual: float = USUAL  # loss of a window from which it counts less

    def part(self, episodes: Sequence[int]) -> Target:
        """Only some episodes."""
        sample = self.roller.sample
        keep = sample.windows_of(episodes)
        roller = Roller(self.roller.twin, sample.part(episodes))
        return dataclasses.replace(self, roller=roller, weights=self.weights[torch.as_tensor(keep)])

    def some(self, windows: NDArray[np.int64]) -> Target:
        """Only some windows."""
        roller = Roller(self.roller.twin, self.roller.sample.some(windows))
        return dataclasses.replace(self, roller=roller, weights=self.weights[torch.as_tensor(windows)])

    def counting(self, usual: float) -> Target:
        """The same where another loss is usual; IN_FULL: no window counts less than it is."""
        return dataclasses.replace(self, usual=usual)

    def losses(self, space: SearchSpace, points: Sequence[Array]) -> Array:
        """(C, E) losses of points."""
        return self.losses_of(self.residuals(space, points))

    def losses_of(self, u: Tensor) -> Array:
        """(C, E) losses of residuals (C, W, K, N, 3) in standard deviations."""
        return self.roller.sample.per_episode(counted(self.per_window(rho(u)), self.usual))

    def counts(self, u: Tensor) -> Array:
        """(W,) the derivative of what a window adds to its episode's loss by its own loss; u (W, K, N, 3)."""
        return np.asarray(1.0 / (1.0 + self.per_window(rho(u[None]))[0] / self.usual))

    def residuals(self, space: SearchSpace, points: Sequence[Array], substeps: int | None = None) -> Tensor:
        """(C, W, K, N, 3) in standard deviations."""
        candidates = [space.candidate(p) for p in points]
        return self.roller.errors(candidates, self.stride, substeps) * self.weights[..., None]

    def per_episode(self, values: Tensor) -> Array:
        """(C, E) means of values (C, W, K, N, 3) over what is seen."""
        return self.roller.sample.per_episode(self.per_window(values))

    def per_window(self, values: Tensor) -> Array:
        """(C, W) means of values (C, W, K, N, 3) over what is seen."""
        seen = seen_of(self.roller, self.stride)
        count = (3 * seen.sum(dim=(1, 2))).clamp_min(1).double()
        return np.asarray((values.sum(dim=(2, 3, 4)).double() / count).numpy())

    def linearize(self, space: SearchSpace, z: Array, least: int = 1) -> tuple[Array, Array, Array, int]:
        """(losses (E,), gradients (E, P), curvatures (E, P, P), substeps) at z by one-sided differences.

        With `least` substeps a period, or more where the points need them.
        """
        lower, upper = (np.array(b) for b in space.bounds())
        step = np.where(z + STEP <= upper, STEP, -STEP)
        step = np.where((step < 0) & (z - STEP < lower), upper - z, step)
        points = [z, *(z + step[d] * np.eye(len(z))[d] for d in range(len(z)))]
        substeps = max(least, self.roller.substeps([space.candidate(p) for p in points]))
        u = self.residuals(space, points, substeps)
        now = u[0]
        slopes = (u[1:] - now) / torch.as_tensor(step, dtype=torch.float32).reshape(-1, 1, 1, 1, 1)
        slopes = slopes.clamp_(-1e3, 1e3)
        soft = (1.0 + now.square()).rsqrt()
        seen = seen_of(self.roller, self.stride)
        count = (3 * seen.sum(dim=(1, 2))).clamp_min(1).double().numpy() / self.counts(now)
        flat = slopes.flatten(2)  # (P, W, R)
        weighted = flat * soft.flatten(1)
        gradient = torch.einsum("pwr,wr->wp", weighted, now.flatten(1)).double().numpy() / count[:, None]
        curvature = torch.einsum("pwr,qwr->wpq", weighted, flat).double().numpy() / count[:, None, None]
        sample = self.roller.sample
        per = sample.per_episode
        return (
            self.losses_of(now[None])[0],
            per(gradient.T).T,
            per(curvature.transpose(1, 2, 0)).transpose(2, 0, 1),
            substeps,
        )


def counted(loss: Array, usual: float) -> Array:
    """What the losses of windows count: usual log(1 + loss / usual), whatever their shape."""
    return np.asarray(usual * np.log1p(loss / usual))


def rho(u: Tensor) -> Tensor:
    """sqrt(1 + u^2) - 1 without cancellation."""
    square = u.square()
    return square / ((1.0 + square).sqrt() + 1.0)


def fit(
    target: Target,
    space: SearchSpace,
    z: Array,
    iterations: int,
    chosen: NDArray[np.bool_] | None = None,
    most: float = MOST_FACTOR,
    slopes: bool = True,
) -> Fit:
    """The local optimum near z, on all episodes or on `chosen` (E,) bool.

    Slopes are taken with every step that is tried: nearly all are taken. Without `slopes` those of the last step are
    not: gradient and curvature are then the ones before it.

    Steps to where more than `most` times the substeps of the start are needed are cut: what the data do not show
    (axial damping) must not make the simulation slow, and what they do show must not wait for it.
    """
    lower, upper = (np.array(b) for b in space.bounds())
    z = np.clip(np.asarray(z, dtype=np.float64), lower, upper)
    origin = z.copy()
    use = np.ones(target.roller.sample.episodes, dtype=bool) if chosen is None else chosen
    damping, longest = 1e-2, LONGEST
    limit = most * max(target.roller.demand(space.candidate(z)), target.roller.usual())
    loss, gradient, curvature, substeps = target.linearize(space, z)
    for step in range(iterations):
        g = gradient[use].mean(axis=0) + PRIOR * (z - origin)
        h = curvature[use].mean(axis=0) + PRIOR * np.eye(len(z))
        before = float(loss[use].mean()) + 0.5 * PRIOR * float(((z - origin) ** 2).sum())
        found = None
        for _ in range(PATIENCE):
            trial = _within(target, space, z, (g, h + damping * np.diag(np.diag(h))), longest, limit)
            if trial is None:
                damping *= 8.0
                continue
            if slopes or step < iterations - 1:
                tried = target.linearize(space, trial, substeps)
            else:
                finer = max(substeps, target.roller.substeps([space.candidate(trial)]))
                tried = target.losses_of(target.residuals(space, [trial], finer))[0], gradient, curvature, finer
            after = float(tried[0][use].mean()) + 0.5 * PRIOR * float(((trial - origin) ** 2).sum())
            if after < before:
                found = trial
                longest *= 2.0 if np.abs(trial - z).max() >= CUT * longest else 1.0
                break
            damping, longest = damping * 8.0, LONGEST
        if found is None:
            break
        z, damping = found, max(damping / 6.0, 1e-6)
        loss, gradient, curvature, substeps = tried
        if before - after < CONVERGED * before:
            break
    return Fit(z, loss, gradient, curvature)


def graduated(target: Target, space: SearchSpace, z: Array, iterations: int, most: float = MOST_FACTOR) -> Fit:
    """The optimum near z, first with all windows in full, whose valley is wider, then as they count.

    Graduated non-convexity (Blake and Zisserman, Visual Reconstruction, 1987).
    """
    wide = fit(target.counting(IN_FULL), space, z, iterations, most=most)
    return fit(target, space, wide.z, iterations, most=most)


def _within(
    target: Target, space: SearchSpace, z: Array, model: tuple[Array, Array], longest: float, limit: float
) -> Array | None:
    """The Newton step of `model` (gradient (P,), curvature (P, P)) from z, cut to `longest` a coordinate. Coordinates
    that would need more substeps than `limit` go part of the way or none, and the others follow them; None: no way.
    """
    g, h = model
    h = h + 1e-12 * np.eye(len(z))
    lower, upper = (np.array(b) for b in space.bounds())

    def after(move: Array) -> Array:
        return np.clip(z + np.clip(move, -longest, longest), lower, upper)

    def needed(point: Array) -> float:
        return target.roller.demand(space.candidate(point))

    move = np.asarray(-np.linalg.solve(h, g), dtype=np.float64)
    whole = after(move)
    if needed(whole) <= limit:
        return whole
    here = needed(z)
    alone = np.where(np.eye(len(z), dtype=bool), whole, z)
    pressing = np.array([needed(point) > STIFFENS * here for point in alone])
    free = ~pressing
    for part in PARTS if pressing.any() else ():
        move = np.where(pressing, part * (whole - z), 0.0)
        if free.any():
            move[free] = -np.linalg.solve(h[np.ix_(free, free)], g[free] + h[np.ix_(free, pressing)] @ move[pressing])
        cut = after(move)
        if needed(cut) <= limit and (cut != z).any():
            return cut
    return None

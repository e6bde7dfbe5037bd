"""Fitting a candidate's parameters to a sample: robust Levenberg-Marquardt on weighted residuals.

The loss of an episode is the mean of rho(u) = sqrt(1 + u^2) - 1 over its windows, frames, seen particles and
coordinates, u the residual in standard deviations (`weigh`).
"""

from __future__ import annotations

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

    def part(self, episodes: Sequence[int]) -> Target:
        """Only some episodes."""
        sample = self.roller.sample
        keep = sample.windows_of(episodes)
        return Target(Roller(self.roller.twin, sample.part(episodes)), self.weights[torch.as_tensor(keep)], self.stride)

    def some(self, windows: NDArray[np.int64]) -> Target:
        """Only some windows."""
        roller = Roller(self.roller.twin, self.roller.sample.some(windows))
        return Target(roller, self.weights[torch.as_tensor(windows)], self.stride)

    def losses(self, space: SearchSpace, points: Sequence[Array]) -> Array:
        """(C, E) losses of points."""
        u = self.residuals(space, points)
        return self.per_episode(rho(u))

    def residuals(self, space: SearchSpace, points: Sequence[Array], substeps: int | None = None) -> Tensor:
        """(C, W, K, N, 3) in standard deviations."""
        candidates = [space.candidate(p) for p in points]
        return self.roller.errors(candidates, self.stride, substeps) * self.weights[..., None]

    def per_episode(self, values: Tensor) -> Array:
        """(C, E) means of values (C, W, K, N, 3) over what is seen."""
        seen = seen_of(self.roller, self.stride)
        count = (3 * seen.sum(dim=(1, 2))).clamp_min(1).double()
        mean = values.sum(dim=(2, 3, 4)).double() / count
        return self.roller.sample.per_episode(mean.numpy())

    def linearize(self, space: SearchSpace, z: Array) -> tuple[Array, Array, Array, int]:
        """(losses (E,), gradients (E, P), curvatures (E, P, P), substeps) at z by one-sided differences."""
        lower, upper = (np.array(b) for b in space.bounds())
        step = np.where(z + STEP <= upper, STEP, -STEP)
        step = np.where((step < 0) & (z - STEP < lower), upper - z, step)
        points = [z, *(z + step[d] * np.eye(len(z))[d] for d in range(len(z)))]
        substeps = self.roller.substeps([space.candidate(p) for p in points])
        u = self.residuals(space, points, substeps)
        now = u[0]
        slopes = (u[1:] - now) / torch.as_tensor(step, dtype=torch.float32).reshape(-1, 1, 1, 1, 1)
        slopes = slopes.clamp_(-1e3, 1e3)
        soft = (1.0 + now.square()).rsqrt()
        seen = seen_of(self.roller, self.stride)
        count = (3 * seen.sum(dim=(1, 2))).clamp_min(1).double().numpy()
        flat = slopes.flatten(2)  # (P, W, R)
        weighted = flat * soft.flatten(1)
        gradient = torch.einsum("pwr,wr->wp", weighted, now.flatten(1)).double().numpy() / count[:, None]
        curvature = torch.einsum("pwr,qwr->wpq", weighted, flat).double().numpy() / count[:, None, None]
        sample = self.roller.sample
        per = sample.per_episode
        return (
            self.per_episode(rho(now[None]))[0],
            per(gradient.T).T,
            per(curvature.transpose(1, 2, 0)).transpose(2, 0, 1),
            substeps,
        )


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
) -> Fit:
    """The local optimum near z, on all episodes or on `chosen` (E,) bool.

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
    for _ in range(iterations):
        g = gradient[use].mean(axis=0) + PRIOR * (z - origin)
        h = curvature[use].mean(axis=0) + PRIOR * np.eye(len(z))
        before = float(loss[use].mean()) + 0.5 * PRIOR * float(((z - origin) ** 2).sum())
        found = None
        for _ in range(PATIENCE):
            trial = _within(target, space, z, (g, h + damping * np.diag(np.diag(h))), longest, limit)
            if trial is None:
                damping *= 8.0
                continue
            finer = max(substeps, target.roller.substeps([space.candidate(trial)]))
            tried = target.per_episode(rho(target.residuals(space, [trial], finer)))[0]
            after = float(tried[use].mean()) + 0.5 * PRIOR * float(((trial - origin) ** 2).sum())
            if after < before:
                found = trial
                longest *= 2.0 if np.abs(trial - z).max() >= CUT * longest else 1.0
                break
            damping, longest = damping * 8.0, LONGEST
        if found is None:
            break
        z, damping = found, max(damping / 6.0, 1e-6)
        loss, gradient, curvature, substeps = target.linearize(space, z)
        if before - after < CONVERGED * before:
            break
    return Fit(z, loss, gradient, curvature)


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


def without_groups(result: Fit, space: SearchSpace, groups: NDArray[np.int64]) -> dict[int, Array]:
    """group -> coordinates that the other groups' episodes give, by one Newton step from the fit; groups (E,)."""
    lower, upper = (np.array(b) for b in space.bounds())
    points = {}
    size = len(result.z)
    for group in sorted(set(groups.tolist())):
        rest = groups != group
        if not rest.any():
            continue
        h = result.curvature[rest].mean(axis=0) + PRIOR * np.eye(size)
        h += 1e-6 * np.trace(h) / size * np.eye(size)
        move = -np.linalg.solve(h, result.gradient[rest].mean(axis=0) - result.gradient.mean(axis=0))
        points[int(group)] = np.clip(result.z + np.clip(move, -LONGEST, LONGEST), lower, upper)
    return points

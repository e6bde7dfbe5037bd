"""Parameters that recordings give without one of them: what its episodes are judged by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.diagnose.fit import LONGEST, PRIOR, Fit, Target
from pred_core.identify.space import SearchSpace
from pred_core.types import Array

RAISED = 0.02  # of the other recordings' loss, by which a step that should lower it may raise it: chaos does so much
DAMPING = (1e-2, 1e-1, 1.0, 10.0, 100.0)  # of the curvature's diagonal, tried where a step raises it


@dataclass(frozen=True)
class LeftOut:
    """The fit without a recording."""

    z: Array  # (P,) coordinates that the other recordings give
    loss: Array  # (E,) of every episode there


def without_each(target: Target, space: SearchSpace, result: Fit, train: NDArray[np.bool_]) -> dict[int, LeftOut]:
    """group -> the fit without it; `result` was fitted to the `train` (E,) episodes of the target.

    One Newton step from the fit. Its curvature is the others' alone and can be nearly singular, and then the step leads
    anywhere: where it raises the others' loss, the best of damped ones (Levenberg-Marquardt) takes its place, or none.
    """
    groups = target.roller.sample.groups
    steps = {group: step_without(result, space, groups[train] != group) for group in _leavable(groups[train])}
    here, *losses = target.losses(space, [result.z, *steps.values()])
    found = {group: LeftOut(z, loss) for (group, z), loss in zip(steps.items(), losses, strict=True)}
    for group, step in found.items():
        rest = train & (groups != group)
        if step.loss[rest].mean() > (1.0 + RAISED) * here[rest].mean():
            damped = [step_without(result, space, groups[train] != group, d) for d in DAMPING]
            tried = [LeftOut(result.z, here), *map(LeftOut, damped, target.losses(space, damped))]
            found[group] = min(tried, key=lambda t: float(t.loss[rest].mean()))
    return found


def _leavable(groups: NDArray[np.int64]) -> list[int]:
    """Groups without which something is left."""
    every = sorted(set(groups.tolist()))
    return every if len(every) > 1 else []


def step_without(result: Fit, space: SearchSpace, rest: NDArray[np.bool_], damping: float = 0.0) -> Array:
    """(P,) coordinates that the episodes `rest` (E,) of a fit give, by one Newton step from it."""
    lower, upper = (np.array(b) for b in space.bounds())
    size = len(result.z)
    h = result.curvature[rest].mean(axis=0) + PRIOR * np.eye(size)
    h += 1e-6 * np.trace(h) / size * np.eye(size) + damping * np.diag(np.diag(h))
    move = -np.linalg.solve(h, result.gradient[rest].mean(axis=0) - result.gradient.mean(axis=0))
    return np.clip(result.z + np.clip(move, -LONGEST, LONGEST), lower, upper)

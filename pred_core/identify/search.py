"""Global search: CMA-ES (Hansen and Ostermeier 2001) with restarts, resumable to the last generation.

Every generation is appended to a journal. A resumed search replays the journal: the strategy is seeded, so it asks
for the same points, is told the stored losses, and goes on where it stopped, exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cma
import numpy as np

from pred_core.identify.journal import Journal
from pred_core.identify.problem import Problem
from pred_core.identify.space import SearchSpace
from pred_core.types import Array

TRIM = 0.1  # share of the worst windows a loss leaves out: damaged recordings must not decide
Report = Callable[[int, int, float], None]  # candidates done, planned, best loss [m]


@dataclass(frozen=True)
class Restart:
    """The best point of one restart."""

    z: Array  # coordinates
    loss: float  # [m]
    seed: int
    evaluations: int


def trimmed(losses: Array) -> Array:
    """(C, W) to (C,): mean over the best 90 % of windows."""
    keep = max(1, int(np.ceil(losses.shape[1] * (1.0 - TRIM))))
    return np.asarray(np.sort(losses, axis=1)[:, :keep].mean(axis=1), dtype=np.float64)


def search(
    problem: Problem, space: SearchSpace, *, seeds: list[int], evaluations: int, journal: Journal, report: Report
) -> list[Restart]:
    """One CMA-ES run a seed, best first. The first starts at the present values, the others at random ones.

    A run ends with the generation that reaches `evaluations`, or before, when it has converged.
    """
    lower, upper = space.bounds()
    size = max(8, 4 + int(3 * np.log(max(len(space.knobs), 1))))
    size += size % 2
    per_run = -(-evaluations // size) * size
    found: list[Restart] = []
    for number, seed in enumerate(seeds):
        rng = np.random.default_rng(seed)
        start = np.clip(rng.normal(0.0, 2.0, len(space.knobs)) if number else space.start(), lower, upper)
        # cma wants at least two dimensions: a single knob gets a companion that changes nothing.
        pad = max(0, 2 - len(space.knobs))
        options = {
            "bounds": [lower + [-1.0] * pad, upper + [1.0] * pad],
            "popsize": size,
            "maxfevals": evaluations,
            "seed": np.nan,  # leaves numpy's global generator alone; all random numbers come from `rng`
            "randn": lambda *shape, rng=rng: rng.standard_normal(shape),
            "verbose": -9,
            "tolfun": 1e-7,
            "tolx": 1e-3,
        }
        strategy = cma.CMAEvolutionStrategy([*start, *[0.0] * pad], 1.0, options)
        best_z, best, done = start, np.inf, 0
        while done < evaluations and not strategy.stop():
            points = np.array(strategy.ask())
            losses = journal.evaluate(points, lambda p: _losses(problem, space, p))
            strategy.tell(list(points), losses.tolist())
            done += len(points)
            leader = int(np.argmin(losses))
            if losses[leader] < best:
                best, best_z = float(losses[leader]), points[leader, : len(space.knobs)]
            report(number * per_run + done, len(seeds) * per_run, min([best, *(f.loss for f in found)]))
        found.append(Restart(np.asarray(best_z), best, seed, done))
    return sorted(found, key=lambda r: r.loss)


def _losses(problem: Problem, space: SearchSpace, points: Array) -> Array:
    return trimmed(problem.losses([space.candidate(p[: len(space.knobs)]) for p in points]))

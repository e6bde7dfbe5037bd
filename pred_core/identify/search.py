"""Global search: CMA-ES (Hansen and Ostermeier 2001) with restarts, resumable to the last evaluation.

Every generation is appended to a journal. A resumed search replays the journal: the strategy is seeded, so it asks
for the same points, is told the stored losses, and goes on where it stopped, exactly.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cma
import numpy as np

from pred_core.errors import ConfigError
from pred_core.identify.problem import Problem
from pred_core.identify.space import SearchSpace
from pred_core.types import Array

TRIM = 0.1  # share of the worst windows a loss leaves out: damaged recordings must not decide
Report = Callable[[int, int, float], None]  # evaluations done, planned, best loss [m]


@dataclass(frozen=True)
class Restart:
    """The best point of one restart."""

    z: Array  # coordinates
    loss: float  # [m]
    seed: int
    evaluations: int


class Journal:
    """Points and losses of finished generations, one JSON line each."""

    def __init__(self, path: Path | None, header: dict[str, object]):
        self.path = path
        self.stored: list[tuple[Array, Array]] = []
        if path is None:
            return
        line = json.dumps({"header": header}, sort_keys=True)
        if path.is_file():
            lines = path.read_text(encoding="utf-8").splitlines()
            if not lines or lines[0] != line:
                raise ConfigError(
                    f"{path}: belongs to another search", next_step=f"Delete {path.parent} or use another --out"
                )
            self.stored = [_parsed(row) for row in lines[1:] if row.endswith("}")]
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(line + "\n", encoding="utf-8")

    def evaluate(self, points: Array, losses: Callable[[Array], Array]) -> Array:
        """Losses of a generation: from the journal while it lasts, else computed and appended."""
        if self.stored:
            known, values = self.stored.pop(0)
            if known.shape == points.shape and np.allclose(known, points, rtol=1e-9, atol=1e-9):
                return values
            raise ConfigError(f"{self.path}: does not replay", next_step="Delete it to search from the start")
        values = losses(points)
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"points": points.tolist(), "losses": values.tolist()}) + "\n")
        return values


def trimmed(losses: Array) -> Array:
    """(C, W) to (C,): mean over the best 90 % of windows."""
    keep = max(1, int(np.ceil(losses.shape[1] * (1.0 - TRIM))))
    return np.sort(losses, axis=1)[:, :keep].mean(axis=1)


def search(
    problem: Problem, space: SearchSpace, *, seeds: list[int], evaluations: int, journal: Journal, report: Report
) -> list[Restart]:
    """One CMA-ES run a seed, best first. The first starts at the present values, the others at random ones."""
    lower, upper = space.bounds()
    size = max(8, 4 + int(3 * np.log(max(len(space.knobs), 1))))
    size += size % 2
    found = []
    for number, seed in enumerate(seeds):
        rng = np.random.default_rng(seed)
        spread = 1.0 if number == 0 else 2.0
        start = np.clip(rng.normal(0.0, spread, len(space.knobs)) if number else space.start(), lower, upper)
        # cma wants at least two dimensions: a single knob gets a companion that changes nothing.
        pad = max(0, 2 - len(space.knobs))
        options = {
            "bounds": [lower + [-1.0] * pad, upper + [1.0] * pad],
            "popsize": size,
            "maxfevals": evaluations,
            "seed": seed + 1,
            "randn": lambda *shape, rng=rng: rng.standard_normal(shape),
            "verbose": -9,
            "tolfun": 1e-7,
            "tolx": 1e-3,
        }
        strategy = cma.CMAEvolutionStrategy([*start, *[0.0] * pad], 1.0, options)
        best_z, best, done = start, np.inf, 0
        while not strategy.stop():
            points = np.array(strategy.ask())
            losses = journal.evaluate(points, lambda p: _losses(problem, space, p))
            strategy.tell(list(points), losses.tolist())
            done += len(points)
            leader = int(np.argmin(losses))
            if losses[leader] < best:
                best, best_z = float(losses[leader]), points[leader, : len(space.knobs)]
            report(number * evaluations + done, len(seeds) * evaluations, min([best, *(f.loss for f in found)]))
        found.append(Restart(np.asarray(best_z), best, seed, done))
    return sorted(found, key=lambda r: r.loss)


def _losses(problem: Problem, space: SearchSpace, points: Array) -> Array:
    candidates = [space.candidate(p[: len(space.knobs)]) for p in points]
    return trimmed(problem.losses(candidates))


def _parsed(row: str) -> tuple[Array, Array]:
    entry = json.loads(row)
    return np.array(entry["points"]), np.array(entry["losses"])

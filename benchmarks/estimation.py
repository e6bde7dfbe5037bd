"""Following a rope with faulty tracks, on exact truth (MuJoCo): the estimate beside tracks alone and the model alone.

    python benchmarks/estimation.py [--ensemble] [--episodes 8] [--seconds 5] [--seed 4100] [--json FILE]

The twin is config/twins/plant_rope, identified on other episodes of the same rope; half of the episodes hang in the
air, half slide on the table. Tracks come at 15 Hz with 2 mm of white and 1 mm of slow error a coordinate. Errors are
mean distances in mm to the same material points of the truth at the time it is asked for (30 Hz, what has arrived by
then), over the fault's time, with a 95 % bootstrap interval over episodes. Tracks alone: the last place each particle
was seen at. Model alone: from the same start, without tracks. Ensemble: `estimation_ensemble.py`, 24 worlds. Cost:
processor time of a period (step and corrections) on one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from argument_types import amount, count
from estimation_ensemble import Ensemble
from estimation_worlds import FAULTS, Fault, World, make_tracks, make_worlds

from pred_core.dynamics import Dynamics
from pred_core.errors import DivergenceError
from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.estimator import Estimator
from pred_core.estimate.grasped import grasp_of
from pred_core.estimate.measurement import Measurement
from pred_core.estimate.starter import Start, Starter
from pred_core.evaluate.bootstrap import bootstrap_interval
from pred_core.pred import load_dynamics
from pred_core.twin import Twin
from pred_core.types import Array, Grip, State

TWIN = Path(__file__).parents[1] / "config" / "twins" / "plant_rope"


class Follower(Protocol):
    """What the estimator and the ensemble have in common."""

    def step(self, stamp: int, grip: Grip) -> State:
        """One period."""

    def correct(self, seen: Measurement) -> object:
        """Take tracks in."""

    @property
    def state(self) -> State:
        """The newest."""


def begin(twin: Twin, world: World, tracks: list[Measurement], config: EstimatorConfig) -> tuple[Start, State, Grip]:
    """The start that the first tracks give, particles in the jaws where the twin knows them."""
    starter = Starter(twin.body, config)
    for seen in tracks:
        starter.add(seen)
        found = starter.find()
        if found is not None and found.stamp > 0.2e9:
            break
    assert found is not None
    held = torch.full((twin.body.count,), -1, dtype=torch.int32)
    held[:2] = 0
    grip = world.grip(found.stamp * 1e-9)
    state = State(torch.as_tensor(found.position, dtype=torch.float32),
                  torch.as_tensor(found.velocity, dtype=torch.float32), held)  # fmt: skip
    grasp = grasp_of(twin.body, state, grip, dict(twin.meta.levers))
    return found, grasp.taken(state, grip, found.track, config.slipped), grip


def follow(one: Follower, period: float, start: Start, world: World, tracks: list[Measurement], fault: Fault) -> Array:
    """(T, N, 3) [m] at the ends of periods; tracks are taken once they have arrived."""
    waiting = [t for t in tracks if t.stamp > start.stamp]
    places = []
    count = int((world.seconds - start.stamp * 1e-9) / period)
    for k in range(1, count + 1):
        stamp = start.stamp + round(k * period * 1e9)
        one.step(stamp, world.grip(stamp * 1e-9))
        while waiting and waiting[0].stamp + fault.delay * 1e9 <= stamp:
            one.correct(waiting.pop(0))
        places.append(one.state.position.double().numpy().copy())
    return np.stack(places)


def hold_last(tracks: list[Measurement], stamps: Array, fault: Fault, count: int) -> Array:
    """(T, N, 3) [m] the newest track of each particle that has arrived at each stamp."""
    places = np.full((len(stamps), count, 3), np.nan)
    last, waiting = np.full((count, 3), np.nan), list(tracks)
    for k, stamp in enumerate(stamps):
        while waiting and waiting[0].stamp + fault.delay * 1e9 <= stamp:
            seen = waiting.pop(0)
            last[seen.index] = seen.position
        places[k] = last
    return places


@dataclass
class Scores:
    """Of one fault: method -> one error [mm] an episode, and times [ms] a period."""

    errors: dict[str, list[float]] = field(default_factory=dict)
    cost: dict[str, list[float]] = field(default_factory=dict)
    rejected: list[tuple[int, int]] = field(default_factory=list)  # rejected, used


def score(
    twin: Twin, dynamics: Dynamics, world: World, fault: Fault, seed: int, scores: Scores, ensemble: bool
) -> None:
    """All methods on one episode with one fault."""
    config = EstimatorConfig()
    tracks = make_tracks(world, fault, np.random.default_rng([seed, zlib.crc32(f"{world.name} {fault.name}".encode())]))
    found, state, grip = begin(twin, world, tracks, config)
    estimator = Estimator(dynamics, twin.body, config)
    methods: dict[str, tuple[Estimator | Ensemble, list[Measurement]]] = {
        "estimate": (estimator, tracks),
        "model alone": (Estimator(dynamics, twin.body, config), []),
    }
    if ensemble:
        methods["ensemble"] = Ensemble(dynamics, twin.body, config, seed), tracks
    count = int((world.seconds - found.stamp * 1e-9) / dynamics.period)
    stamps = found.stamp + np.round(np.arange(1, count + 1) * dynamics.period * 1e9)
    low, high = fault.span
    judged = (stamps * 1e-9 >= low) & (stamps * 1e-9 < high)
    truth = world.record.position_at(stamps * 1e-9)
    places = {"tracks alone": hold_last(tracks, stamps, fault, twin.body.count)}
    for name, (one, given) in methods.items():
        one.start(found.stamp, state, grip)
        before = time.process_time()
        try:
            with torch.no_grad():
                places[name] = follow(one, dynamics.period, found, world, given, fault)
        except DivergenceError:
            places[name] = np.full_like(truth, np.nan)
        scores.cost.setdefault(name, []).append(1e3 * (time.process_time() - before) / count)
    for name, place in places.items():
        scores.errors.setdefault(name, []).append(float(1e3 * np.linalg.norm(place - truth, axis=-1)[judged].mean()))
    scores.rejected.append((estimator.tally.rejected, estimator.tally.used))


def cell(values: list[float]) -> str:
    """Mean with its interval; episodes that diverged are counted beside it."""
    array = np.array(values)
    good = array[np.isfinite(array)]
    low, high = bootstrap_interval(good, np.random.default_rng(0))
    lost = f", {len(array) - len(good)} diverged" if len(good) < len(array) else ""
    return f"{good.mean():.1f} [{low:.1f}, {high:.1f}]{lost}"


def table(results: dict[str, Scores]) -> str:
    """Markdown."""
    names = [n for n in ("estimate", "tracks alone", "model alone", "ensemble") if n in results["none"].errors]
    lines = ["| tracks | " + " | ".join(names) + " | rejected |", "|---" * (len(names) + 2) + "|"]
    for fault in FAULTS:
        r = results[fault.name]
        rejected, used = np.sum(r.rejected, axis=0)
        cells = [cell(r.errors[n]) for n in names]
        lines.append(f"| {fault.said} | " + " | ".join(cells) + f" | {100 * rejected / (rejected + used):.1f} % |")
    costs = {n: np.mean([c for r in results.values() for c in r.cost[n]]) for n in names if n != "tracks alone"}
    lines.append("")
    lines.append("processor time a period [ms]: " + ", ".join(f"{n} {c:.2f}" for n, c in costs.items()))
    return "\n".join(lines)


def main() -> None:
    """Simulate, follow, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=count(1, 1000), default=8)
    parser.add_argument("--seconds", type=amount(1.0, 600.0), default=5.0)
    parser.add_argument("--seed", type=count(0), default=4100)
    parser.add_argument("--ensemble", action="store_true", help="beside it, at three times its cost")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    twin = Twin.load(TWIN)
    dynamics = load_dynamics(twin)
    results = {fault.name: Scores() for fault in FAULTS}
    for world in make_worlds(asked.episodes, asked.seconds, asked.seed):
        print(f"{world.name} ...", file=sys.stderr, flush=True)
        for fault in FAULTS:
            score(twin, dynamics, world, fault, asked.seed, results[fault.name], asked.ensemble)
    print(table(results))
    if asked.json is not None:
        asked.json.write_text(json.dumps({name: asdict(r) for name, r in results.items()}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()

"""What could be avoided at most: our simulator with the true law, fitted on the same data with the same budget.

The law is known, its parameters are not: they are fitted as a diagnosis fits a candidate, from the starts of three
screenings and from where the diagnosis ended, if it fitted the same law. What the sensors get wrong is corrected by
its true value. A law outside the library has no oracle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hidden_bench import pieces, rebuilt
from hidden_cases import Case
from hidden_scores import SAME

from pred_core.bag.dataset import load_dataset
from pred_core.calibration import Calibration
from pred_core.diagnose.commission import with_values
from pred_core.diagnose.errors import episode_errors
from pred_core.diagnose.fit import Fit, fit
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Bench, Effects, rng_of, screen
from pred_core.diagnose.search import Start
from pred_core.effects import find_effect
from pred_core.plant.hidden.measurement import camera_place
from pred_core.types import Array

RESTARTS = 3
SENSORS = ("action_delay", "camera_scale", "camera_rotation", "gripper_offset")  # corrected, never simulated


def has_oracle(case: Case) -> bool:
    """Something is hidden, and the library has a name for all of it; two errors of one camera are not put together."""
    names = [name for name, _ in case.hidden]
    return bool(names) and all(SAME[n].id for n in names) and sum(n.startswith("camera") for n in names) < 2


def oracle(case: Case, work: Path, twin: Path, answer: Path) -> dict[str, Any]:
    """{"error_mm", "error_mm_ood" (None: no such episodes), "parameters"} of the oracle of a case."""
    calibration = _calibration(case)
    episodes = [calibration.correct(e) for e in load_dataset(work / case.name).episodes()]
    known = pieces(answer)
    bench = rebuilt(twin, episodes, list(load_dataset(work / case.reference).episodes()), known)
    effects: Effects = tuple(find_effect(SAME[n].id) for n, _ in case.hidden if n not in SENSORS)
    values: dict[str, float] = {}
    extended = bench.twin
    if effects:
        z = _fitted(bench, effects, known)
        space = bench.trial(effects).space
        extended, values = with_values(bench.twin, space.candidate(z)), space.values(z)
    begin = min(int(e.stamps[0]) for e in episodes)  # of the session: what drifts began there
    errors = {
        split: episode_errors(extended, [e for e in episodes if e.split == split], begin).mean
        for split in ("test", "ood")
        if any(e.split == split for e in episodes)
    }
    return {"error_mm": errors["test"], "error_mm_ood": errors.get("ood"), "parameters": values}


def _fitted(bench: Bench, effects: Effects, known: dict[str, Any]) -> Array:
    """Coordinates with the least loss on the train episodes, of all restarts."""
    trial = bench.trial(effects)
    fits = []
    for restart in range(RESTARTS):
        found = screen(bench, effects, rng_of(restart, f"oracle/{trial.id}"), Journal(None, {}), "screen")
        fits.append(_from_best(bench, effects, found.starts))
        if not any(q.scan for e in effects for q in e.parameters):
            break  # one start only: the others would be the same
    for key in (f"0/fit/{trial.id}", f"0/pair/{trial.id}"):
        if key in known and len(known[key]["z"]) == len(trial.space.knobs):
            fits.append(fit(bench.fitted, trial.space, np.array(known[key]["z"]), bench.config.iterations))
    return min(fits, key=lambda f: float(f.loss.mean())).z


def _from_best(bench: Bench, effects: Effects, starts: Sequence[Start]) -> Fit:
    """The refinement of the start that two steps bring farthest."""
    space = bench.trial(effects).space
    short = [fit(bench.fitted, space, s.z, 2) for s in starts] if len(starts) > 1 else []
    first = min(short, key=lambda f: float(f.loss.mean())).z if short else starts[0].z
    return fit(bench.fitted, space, first, bench.config.iterations)


def _calibration(case: Case) -> Calibration:
    """What the sensors of a case truly get wrong; the hidden world draws it in this order."""
    wrong: dict[str, Any] = {}
    for place, (name, magnitude) in enumerate(case.hidden):
        generator = np.random.default_rng([case.seed, 2, place])
        if name == "action_delay":
            wrong["delay"] = 1e-3 * magnitude
        elif name == "camera_scale":
            wrong |= {"scale": 1.0 + magnitude, "center": _three(camera_place(generator))}
        elif name == "camera_rotation":
            center = camera_place(generator)
            axis = generator.normal(size=3)
            turn = math.radians(magnitude) * axis / np.linalg.norm(axis)
            wrong |= {"rotation": _three(turn), "center": _three(center)}
        elif name == "gripper_offset":
            azimuth, lift = generator.uniform(0.0, 2.0 * np.pi), generator.uniform(-0.4, 0.4)
            direction = (math.cos(azimuth) * math.cos(lift), math.sin(azimuth) * math.cos(lift), math.sin(lift))
            wrong["gripper_offset"] = _three(magnitude * np.array(direction))
    return Calibration(**wrong)


def _three(values: Sequence[float] | Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z

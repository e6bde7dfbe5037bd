"""How strong a hidden effect is: the base's error on the same motions, noise and drop-outs with nothing hidden.

Motions differ more between cases than most effects add, so that the controls of a reference say little of one case.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hidden_bench import commissioned
from hidden_cases import SESSION, Case

from pred_core.bag.dataset import Dataset, load_dataset, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.diagnose.errors import episode_errors
from pred_core.plant.rope_case import simulate_rope
from pred_core.plant.sensing import SensorConfig, draw_seen, observe
from pred_core.plant.session import plan_session


def paired(case: Case, work: Path, twin: Path, answer: Path) -> dict[str, float]:
    """{"error_mm"} [mm] of the base on the test episodes of the case's session without its effects."""
    like = load_dataset(work / case.name)
    with TemporaryDirectory() as folder:
        episodes = list(_without_effects(case.seed, like, Path(folder)).episodes())
    return {"error_mm": episode_errors(commissioned(twin, answer), episodes).mean}


def _without_effects(seed: int, like: Dataset, root: Path) -> Dataset:
    """The test episodes of a session, written as `write_rope_case` writes them."""
    sensor = SensorConfig()
    for plan in plan_session(SESSION, seed):
        if plan.split != "test":
            continue
        record, effects = simulate_rope(plan, (), seed, SESSION.seconds, SESSION.particles)
        seen = draw_seen(sensor, np.random.default_rng([seed, 3, plan.index]), SESSION.seconds, SESSION.particles)
        write_episode(root / f"{plan.name}.mcap", observe(plan, record, seen, effects, like.object))
    entries = [e for e in like.entries if e.split == "test"]
    return write_dataset(
        root, object=like.object, rate=like.rate, entries=entries, sigma=like.sigma, held=like.held, known=like.known
    )

"""A case: one data set of a session, and beside it (never in it) the truth about what is hidden."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pred_core.bag.dataset import Dataset, EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.errors import DatasetError
from pred_core.plant.hidden.effect import HiddenEffect
from pred_core.plant.sensing import SensorConfig, draw_seen, observe
from pred_core.plant.session import EpisodePlan, SessionConfig, plan_session
from pred_core.plant.world import Record
from pred_core.types import ObjectInfo

Progress = Callable[[int, int, str], None]  # done, total, name
# Simulates the given episodes one by one, each with the effects that act on its measurement.
Simulate = Callable[[Sequence[EpisodePlan]], Iterator[tuple[EpisodePlan, Record, Sequence[HiddenEffect]]]]


def truth_path(root: Path) -> Path:
    """Where the truth about a data set stands: beside its folder."""
    root = root if root.name not in ("", "..") else root.resolve()
    return root.with_name(f"{root.name}.truth.json")


def write_case(
    root: Path,
    *,
    truth: Mapping[str, Any],
    simulate: Simulate,
    session: SessionConfig,
    sensor: SensorConfig,
    seed: int,
    known: Mapping[str, float],
    progress: Progress,
) -> Dataset:
    """Simulate the episodes that are not there yet, write their bags, then `dataset.yaml`.

    `truth` identifies the case; nothing in `root` depends on it but the tracks. Raises: DatasetError if `root` holds
    another case or other files.
    """
    _claim(root, truth)
    plans = plan_session(session, seed)
    object = ObjectInfo("rope", "line")
    missing = [p for p in plans if not (root / f"{p.name}.mcap").exists()]
    for done, (plan, record, effects) in enumerate(simulate(missing), start=1):
        generator = np.random.default_rng([seed, 3, plan.index])
        seen = draw_seen(sensor, generator, session.seconds, session.particles)
        write_episode(root / f"{plan.name}.mcap", observe(plan, record, seen, effects, object))
        progress(done, len(missing), plan.name)
    usual = {0: 0, 1: 0}
    held = [plan.held(session.particles) for plan in plans]
    return write_dataset(
        root,
        object=object,
        rate=sensor.rate,
        entries=[
            EpisodeEntry(f"{p.name}.mcap", p.split, p.recording, None if h == usual else h)
            for p, h in zip(plans, held, strict=True)
        ],
        sigma=float(np.hypot(sensor.noise, sensor.wander)),
        held=usual,
        known=known,
    )


def _claim(root: Path, truth: Mapping[str, Any]) -> None:
    """Make `root` the folder of this case, or find that it already is."""
    beside = truth_path(root)
    wanted = json.loads(json.dumps(dict(truth)))
    try:
        root.mkdir(parents=True, exist_ok=True)
        for partial in root.glob(".*.part"):
            partial.unlink()
        if not beside.exists():
            if any(root.iterdir()):
                raise DatasetError(
                    f"{root}: not empty, and no {beside.name} beside it says what it is", next_step="Use a new folder"
                )
            partial = beside.with_name(f".{beside.name}.part")
            partial.write_text(json.dumps(wanted, indent=2) + "\n", encoding="utf-8")
            partial.replace(beside)
        found = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DatasetError(f"{root}: cannot be used as a data set folder", got=error) from error
    if found != wanted:
        differ = [k for k in wanted if not isinstance(found, dict) or found.get(k) != wanted[k]]
        raise DatasetError(
            f"{root}: holds another case",
            got=f"other {', '.join(differ) or 'settings'} in {beside.name}",
            next_step="Use a new folder, or remove this one and the truth beside it",
        )

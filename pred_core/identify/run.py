"""The whole identification: layout, global search, refinement, held-out check, twin."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pred_core.bag.dataset import Dataset
from pred_core.identify.config import IdentifyConfig
from pred_core.identify.evidence import Values, gather_evidence
from pred_core.identify.journal import Journal
from pred_core.identify.levers import mean_levers
from pred_core.identify.prepare import prepare
from pred_core.identify.refine import OUTLIER
from pred_core.identify.search import trimmed
from pred_core.identify.space import Candidate
from pred_core.identify.stages import ROOM, Tell
from pred_core.train.recordings import Recording, split_groups
from pred_core.twin import Extension, Twin, TwinMeta
from pred_core.types import Array, Episode


@dataclass(frozen=True)
class Identified:
    """The twin and what the report shows."""

    twin: Twin
    values: Values  # per knob, see `evidence.Evidence`
    restarts: list[dict[str, float]]
    fitted_mm: float
    held_out_mm: float | None
    windows: dict[str, float]  # episode -> error over its whole length [mm]
    left_out: tuple[str, ...]  # episodes the last refinement left out as outliers
    noise_mm: float
    seconds: float
    seed: int

    def summary(self) -> dict[str, object]:
        """What `identify.json` holds: all but the twin."""
        return {
            "parameters": self.values,
            "restarts": self.restarts,
            "error_mm": {"fitted": self.fitted_mm, "held_out": self.held_out_mm, "episodes": self.windows},
            "left_out": list(self.left_out),
            "notes": list(self.twin.meta.notes),
            "track_noise_mm": self.noise_mm,
            "seconds": self.seconds,
            "seed": self.seed,
        }


def identify(
    dataset: Dataset,
    episodes: Sequence[Episode],
    config: IdentifyConfig,
    journal_path: Path | None,
    tell: Tell,
    command: str = "",
) -> Identified:
    """Fit a twin to the train episodes. Held-out recordings check the fit, then the refinement uses all.

    Raises: DatasetError or ConfigError on unusable data or settings.
    """
    begin = time.monotonic()
    prepared = prepare(dataset, episodes, config, tell)
    stages, space, recordings, notes = prepared.stages, prepared.space, prepared.recordings, list(prepared.notes)
    fitted, held_out = _split(recordings, config)
    if config.hold_out > 0 and not held_out:
        notes.append("one recording only: nothing is held out, the error is that of the fit")
    for note in notes:
        tell(f"note: {note}")
    searched = space.coarse()
    hashes = tuple(dataset.sha256(e) for e in dataset.select("train"))

    journal = Journal(journal_path, {"config": repr(config), "data": hashes, "object": repr(dataset.object)})
    restarts = stages.search(fitted, searched, journal)
    best = searched.candidate(restarts[0].z)
    check = stages.check(best, held_out, "CMA-ES") if held_out else None
    best, refined = stages.refine(fitted, space, best, config.stages)
    if held_out:
        check = stages.check(best, held_out, "refined")
        best, refined = stages.refine(recordings, space, best, config.stages[-1:])
    tell("evidence: intervals and sensitivities")
    problem = stages.whole(recordings)
    # What keeps it stable whatever the motion, also where the refinement was simulated with fewer.
    substeps = max(1, math.ceil(problem.demand(best)))
    losses = problem.losses([best], substeps)[0]
    wall = stages.most_substeps * (1.0 if refined is None else ROOM)
    values = gather_evidence(problem, space, searched, best, restarts, wall)
    meta = TwinMeta(
        object=dataset.object,
        period=stages.period,
        substeps=substeps,
        held=tuple((dataset.held or {}).items()),
        levers=mean_levers(recordings, [int(k) for k in stages.layout.body.id]),
        created_by=command,
        data=hashes,
        notes=tuple(notes),
    )
    report = {k: {a: b for a, b in v.items() if a not in ("value", "unit")} for k, v in values.items() if "." not in k}
    errors = _per_episode(problem.windows.names, losses)
    bad = tuple(n for n, v in errors.items() if v > OUTLIER * np.median(list(errors.values())))
    return Identified(
        twin=Twin(
            meta=meta,
            body=stages.body(best.physics),
            physics=best.physics,
            scene=stages.layout.scene,
            extensions=_with_evidence(best, values),
            physics_report=report,
        ),
        values=values,
        restarts=[
            {"seed": r.seed, "loss_mm": 1e3 * r.loss, "evaluations": r.evaluations, **searched.values(r.z)}
            for r in restarts
        ],
        fitted_mm=1e3 * float(trimmed(losses[None])[0]),
        held_out_mm=check,
        windows=errors,
        left_out=bad if refined is None else refined.left_out,
        noise_mm=1e3 * prepared.noise,
        seconds=time.monotonic() - begin,
        seed=config.seed,
    )


def train_episodes(dataset: Dataset) -> list[Episode]:
    """The train split, read into memory. Raises: DatasetError if it is empty, BagError for a bad bag."""
    return list(dataset.episodes("train"))


def _split(recordings: list[Recording], config: IdentifyConfig) -> tuple[list[Recording], list[Recording]]:
    if config.hold_out == 0 or len({r.group for r in recordings}) == 1:
        return recordings, []
    return split_groups(recordings, config.hold_out, torch.Generator().manual_seed(config.seed))


def _with_evidence(candidate: Candidate, values: Values) -> tuple[Extension, ...]:
    return tuple(
        dataclasses.replace(e, evidence={k.split(".", 1)[1]: v for k, v in values.items() if k.startswith(e.id + ".")})
        for e in candidate.extensions
    )


def _per_episode(names: Sequence[str], losses: Array) -> dict[str, float]:
    """Mean error [mm] of each episode's windows."""
    groups: dict[str, list[float]] = {}
    for name, loss in zip(names, losses.tolist(), strict=True):
        groups.setdefault(name, []).append(1e3 * loss)
    return {n: float(np.mean(v)) for n, v in groups.items()}

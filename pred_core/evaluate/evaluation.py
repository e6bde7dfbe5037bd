"""Models x splits x metrics: predictions (cached), scores, and the entries of `metrics.json`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pred_core.bag.dataset import Dataset, EpisodeEntry
from pred_core.calibration import Calibration
from pred_core.errors import PredError
from pred_core.evaluate.cache import PredictionCache
from pred_core.evaluate.models import Model, check_unseen
from pred_core.evaluate.protocol import FIRST_PREDICTED, check_episodes, predict
from pred_core.evaluate.scores import EpisodeScore, metrics_table, over_steps, score_episode
from pred_core.evaluate.splits import Split, recordings_on_both_sides
from pred_core.types import Array, Episode

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Result:
    """One model on one split, episodes in the order of the folds."""

    model: Model
    split: Split
    episodes: tuple[Episode, ...]
    predictions: tuple[Array, ...]  # each (T-2, P, 3) [m], NaN after a divergence
    scores: tuple[EpisodeScore, ...]
    tested_on_training_data: int  # episodes the twin was fitted on, by bag hash
    same_recording: int  # episodes whose recording the model may have seen

    def values(self, metric: str) -> dict[str, float]:
        """Mean over all steps per episode that did not diverge."""
        return {s.name: over_steps(s, metric) for s in self.scores if s.diverged is None}


@dataclass(frozen=True)
class NotComputed:
    """A model that could not be run on a split, and why."""

    model: str
    split: str
    reason: str


class EpisodeStore:
    """Episodes of a data set, each read once and corrected by one calibration: every model meets the same data."""

    def __init__(self, dataset: Dataset, calibration: Calibration | None = None):
        self.dataset = dataset
        self.calibration = calibration or Calibration()
        self._read: dict[str, Episode] = {}

    def read(self, entries: Sequence[EpisodeEntry]) -> list[Episode]:
        """The episodes of `entries`. Raises: BagError."""
        for entry in entries:
            if entry.bag not in self._read:
                self._read[entry.bag] = self.calibration.correct(self.dataset.read(entry))
        return [self._read[e.bag] for e in entries]

    def session(self) -> int:
        """[ns] when the session began, as a diagnosis has it: the first stamp of all episodes, of any split.

        Raises: BagError.
        """
        return min(int(e.stamps[0]) for e in self.read(self.dataset.entries))


def run_model(model: Model, split: Split, store: EpisodeStore, cache: PredictionCache, say: Progress) -> Result:
    """Predict and score every fold of `split`. Raises: PredError of the model or the data."""
    episodes: list[Episode] = []
    predictions: list[Array] = []
    trained_on, same_recording = 0, 0
    begin = store.session() if model.drifts else None
    for index, fold in enumerate(split.folds):
        number = index if split.grouped else None
        test = store.read(fold.test)
        check_episodes(test)
        clock = "" if begin is None else f" session from {begin}"
        key = cache.key(model.digest, f"{fold.digest}{_corrected(store.calibration)}{clock}", number)
        found = cache.load(key, [(len(e.stamps) - FIRST_PREDICTED, len(e.tracks.id), 3) for e in test])
        if found is None:
            dynamics = model.build(test, store.read(fold.train), number)
            found = [p.astype(np.float32).astype(np.float64) for p in predict(dynamics, test, begin)]
            cache.store(key, found)
            say(f"{model.name} on {split.name}" + (f" fold {index + 1}/{len(split.folds)}" if split.grouped else ""))
        else:
            say(f"{model.name} on {split.name}: kept from before")
        if not split.grouped:  # fold twins are checked before anything is predicted
            trained_on += len(set(fold.test_hashes) & set(model.fitted_on))
        same_recording += recordings_on_both_sides(fold)
        episodes += test
        predictions += found
    scores = tuple(score_episode(p, e) for p, e in zip(predictions, episodes, strict=True))
    return Result(model, split, tuple(episodes), tuple(predictions), scores, trained_on, same_recording)


def _corrected(calibration: Calibration) -> str:
    return "" if calibration.identity else f" {calibration}"


def run_all(
    models: Sequence[Model],
    optional: frozenset[str],
    splits: Sequence[Split],
    store: EpisodeStore,
    cache: PredictionCache,
    say: Progress,
) -> tuple[list[Result], list[NotComputed]]:
    """Every model on every split. A model named in `optional`, and any twin without equal twins for the folds of
    a grouped split, is listed as not computed with its reason; any other failure is raised.

    Raises: TwinError before anything is predicted if a fold twin was fitted on what its fold tests.
    """
    results, missing = [], []
    for model in models:
        for split in splits:
            if split.grouped and model.fold_twins == len(split.folds):
                check_unseen(model, split.folds)
    for split in splits:
        for model in models:
            if split.grouped and model.fold_twins is not None and model.fold_twins != len(split.folds):
                missing.append(NotComputed(model.name, split.name, _fold_reason(model, split)))
                continue
            if split.grouped and model.lacking:
                missing.append(NotComputed(model.name, split.name, model.lacking))
                continue
            try:
                results.append(run_model(model, split, store, cache, say))
            except PredError as error:
                if model.name not in optional:
                    raise
                missing.append(NotComputed(model.name, split.name, str(error)))
    return results, missing


def entry(result: Result, seed: int) -> dict[str, Any]:
    """The entry of one model and split in `metrics.json`. The bootstrap is drawn from `seed`, the same for all."""
    usable = [s for s in result.scores if s.diverged is None]
    return {
        "model": result.model.name,
        "split": result.split.name,
        "grouped_by_recording": result.split.grouped,
        "folds": len(result.split.folds),
        "episodes_tested": len(result.scores),
        "diverged": [{"episode": s.name, "step": s.diverged} for s in result.scores if s.diverged is not None],
        "data_sha256": [fold.digest for fold in result.split.folds],
        "hidden_particle_frames": sum(s.hidden for s in result.scores),
        "tested_on_training_data": result.tested_on_training_data,
        "episodes_sharing_a_recording_with_training": result.same_recording,
        "metrics": metrics_table(usable, seed),
    }


def _fold_reason(model: Model, split: Split) -> str:
    return (
        f"a twin must be fitted anew without each fold's recordings: {model.fold_twins} fold twins given for "
        f"{len(split.folds)} folds (--fold-twins)"
    )

"""Which episodes are tested and which ones a model may have seen: as published, or grouped by recording."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from pred_core.bag.dataset import Dataset, EpisodeEntry, Fold


@dataclass(frozen=True)
class HashedFold(Fold):
    """Episodes to test, those a model tested on them may be fitted on, and their hashes."""

    digest: str  # sha256 over names and bag hashes of both
    test_hashes: tuple[str, ...]  # sha256 of every tested bag


@dataclass(frozen=True)
class Split:
    """A named way to test. `grouped`: several folds, models must be refitted for each."""

    name: str
    folds: tuple[HashedFold, ...]
    grouped: bool


def published(dataset: Dataset, test: str) -> Split:
    """The split written in the data set. It leaks where windows of one recording are on both sides."""
    train = dataset.select("train") if "train" in dataset.splits and test != "train" else ()
    return Split(test, (_fold(dataset, dataset.select(test), train),), grouped=False)


def grouped(dataset: Dataset, folds: int) -> Split:
    """Every episode is tested once by a model that saw no episode of its recording."""
    made = tuple(_fold(dataset, f.test, f.train) for f in dataset.grouped_folds(folds))
    return Split(f"grouped_by_recording_{folds}_fold", made, grouped=True)


def recordings_on_both_sides(fold: Fold) -> int:
    """Number of tested episodes whose recording also has training episodes."""
    trained = {e.recording for e in fold.train}
    return sum(e.recording in trained for e in fold.test)


def _fold(dataset: Dataset, test: tuple[EpisodeEntry, ...], train: tuple[EpisodeEntry, ...]) -> HashedFold:
    sha = hashlib.sha256(repr((dataset.object, dataset.rate, dataset.gravity, dataset.held)).encode())
    hashes = {e.bag: dataset.sha256(e) for e in (*test, *train)}
    for side in (test, train):
        for entry in side:
            sha.update(f"{entry.bag} {entry.recording} {hashes[entry.bag]}\n".encode())
        sha.update(b"--\n")
    return HashedFold(train, test, sha.hexdigest(), tuple(hashes[e.bag] for e in test))

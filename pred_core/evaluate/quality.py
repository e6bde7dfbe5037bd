"""The data gate over the whole data set, kept beside the predictions: the same on every run."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from pred_core.bag.dataset import Dataset
from pred_core.bag.gate import EpisodeQuality, examine_all
from pred_core.evaluate.cache import code_digest, tell_damaged


def data_quality(dataset: Dataset, folder: Path) -> list[EpisodeQuality]:
    """Findings on every episode of the data set, whichever are evaluated: usual distances are medians over all.

    Kept in `folder`, named by the hash of the bags, of dataset.yaml's facts and of the code.
    Raises: BagError for a bag that cannot be read.
    """
    path = folder / f"gate_{_digest(dataset)}.json"
    found = _load(path)
    if found is None:
        found = examine_all(dataset.episodes)
        folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps([dataclasses.asdict(q) for q in found]), encoding="utf-8")
        os.replace(partial, path)
    return found


def _digest(dataset: Dataset) -> str:
    facts = repr((dataset.object, dataset.rate, dataset.gravity, dataset.held, dataset.entries, code_digest()))
    sha = hashlib.sha256(facts.encode())
    for entry in dataset.entries:
        sha.update(dataset.sha256(entry).encode())
    return sha.hexdigest()[:32]


def _load(path: Path) -> list[EpisodeQuality] | None:
    if not path.is_file():
        return None
    try:
        stored: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))
        return [EpisodeQuality(**{**q, "flags": tuple(q["flags"])}) for q in stored]
    except (OSError, ValueError, TypeError, KeyError) as error:
        tell_damaged(path, error)
        return None

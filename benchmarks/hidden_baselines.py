"""What simpler ways would have answered on the same cases, in the form of a diagnosis.

largest_gain   of the candidates that were fitted, the one that fits its own data best (no held-out episodes)
aic            the one with the least Akaike criterion on its own data, or none
sindy          sparse regression on accelerations

The first two see what the model-free gate found, as the diagnosis does, and keep its names.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import hidden_sindy
import numpy as np
from hidden_bench import pieces, rebuilt
from hidden_cases import Case

from pred_core.bag.dataset import Dataset, load_dataset
from pred_core.diagnose.weigh import seen_of
from pred_core.effects import find_effect
from pred_core.twin import Twin

METHODS = ("largest_gain", "aic", "sindy")
KEPT = ("error_mm", "error_mm_ood", "seconds")  # of the diagnosis, so that all are judged at the same strength


def baselines(case: Case, work: Path, twin: Path, answer: Path) -> dict[str, dict[str, Any]]:
    """Method -> answer. Reads the diagnosis of the case and its journal."""
    diagnosis = json.loads((answer / "diagnosis.json").read_text(encoding="utf-8"))
    dataset, reference = load_dataset(work / case.name), load_dataset(work / case.reference)
    result = in_sample(dataset, reference, twin, answer)
    found, share = sindy(dataset, reference)
    result["sindy"] = said(found, share)
    measured = [c for c in diagnosis["causes"] if c.get("kind") == "measurement"]
    for method in ("largest_gain", "aic"):
        if measured:
            result[method]["outcome"] = "named"
            result[method]["causes"] = [*measured, *result[method]["causes"]]
    return {m: {**{k: diagnosis[k] for k in KEPT}, **result[m]} for m in METHODS}


def said(id: str, probability: float) -> dict[str, Any]:
    """An answer with one name, or none."""
    ranking = [{"id": id, "probability": probability}]
    if id == "none":
        return {"outcome": "none", "causes": [], "ranking": ranking}
    cause = {"id": id, "family": find_effect(id).family, "probability": probability, "kind": "physics", "group": [],
             "parameters": {}}  # fmt: skip
    return {"outcome": "named", "causes": [cause], "ranking": ranking}


def in_sample(dataset: Dataset, reference: Dataset, twin: Path, answer: Path) -> dict[str, dict[str, Any]]:
    """Answers of the two that judge a fit by the data it was fitted to."""
    known = pieces(answer)
    calibration = Twin.load(answer / "twin").calibration
    bench = rebuilt(twin, [calibration.correct(e) for e in dataset.episodes()], list(reference.episodes()), known)
    count = float(3 * seen_of(bench.fitted.roller, bench.fitted.stride).sum())
    rows = []  # id, loss before and after, parameters
    for key, value in known.items():
        if not key.startswith("0/fit/"):
            continue
        trial = bench.trial((find_effect(key.removeprefix("0/fit/")),))
        null, fitted = bench.fitted.losses(trial.space, [trial.space.start(), np.array(value["z"])]).mean(axis=1)
        rows.append((trial.id, float(null), float(fitted), len(trial.space.knobs)))
    if not rows:
        return {"largest_gain": said("none", 1.0), "aic": said("none", 1.0)}
    best = max(rows, key=lambda r: r[1] - r[2])
    gains = sum(max(r[1] - r[2], 0.0) for r in rows)
    criterion = {"none": 2.0 * count * rows[0][1], **{r[0]: 2.0 * count * r[2] + 2.0 * r[3] for r in rows}}
    least = min(criterion, key=lambda k: criterion[k])
    weights = {k: math.exp(-0.5 * min(v - criterion[least], 1e3)) for k, v in criterion.items()}
    return {
        "largest_gain": said(best[0], (best[1] - best[2]) / gains) if best[1] > best[2] else said("none", 1.0),
        "aic": said(least, weights[least] / sum(weights.values())),
    }


def sindy(dataset: Dataset, reference: Dataset) -> tuple[str, float]:
    """Answer of the regression on the train episodes of both sets."""
    parts = []
    for source in (dataset, reference):
        episodes = list(source.episodes())
        begin = min(int(e.stamps[0]) for e in episodes)
        parts.append([hidden_sindy.normal(e, begin) for e in episodes if e.split == "train"])
    return hidden_sindy.name(*parts)

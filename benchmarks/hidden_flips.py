"""Whether gains of the episodes of one recording are alike where nothing is hidden, from journals of controls."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from hidden_bench import pieces
from numpy.typing import NDArray

from pred_core.bag.dataset import load_dataset
from pred_core.diagnose.evidence import family_wise
from pred_core.errors import ConfigError
from pred_core.types import Array


def flips(cases: Sequence[tuple[Path, Path]]) -> list[str]:
    """Lines about (data set, answer) of controls: their smallest p values, and the intraclass correlation of gains.

    Raises: ConfigError if no candidate was fitted to any of them, or its journal is gone.
    """
    alike: list[float] = []
    smallest: list[float] = []
    for dataset, answer in cases:
        groups = np.array([e.recording for e in load_dataset(dataset).entries if e.split != "ood"])
        gains = [np.array(v["gain"]) for k, v in pieces(answer).items() if k.startswith("0/fit/")]
        if not gains:
            continue
        smallest.append(float(family_wise([SimpleNamespace(gain=g) for g in gains], 0, groups).min()))
        alike += [correlation(g, groups) for g in gains if g.std() > 0.0]
    if not alike:
        got = f"{len(smallest)} of {len(cases)} with gains of fitted candidates"
        raise ConfigError("journals of controls", got=got, next_step="Run the cases first, and keep journal.jsonl")
    low = ", ".join(f"{p:.3f}" for p in sorted(smallest)[:5])
    return [
        f"{len(smallest)} controls, smallest p values by sign flips (recordings, or episodes of fewer than ten): {low}",
        f"intraclass correlation of gains in a recording: mean {np.mean(alike):.2f}, median {np.median(alike):.2f}, "
        f"{len(alike)} fits",
    ]


def correlation(values: Array, groups: NDArray[np.int64]) -> float:
    """Intraclass correlation of values (E,) in groups (E,) of unequal size: one-way analysis of variance.

    (B - W) / (B + (n - 1) W) with the mean squares between and within groups and the usual size n of one (Donner 1986).
    """
    _, group, size = np.unique(groups, return_inverse=True, return_counts=True)
    mean = np.bincount(group, values) / size
    count, k = len(values), len(size)
    between = float((size * (mean - values.mean()) ** 2).sum()) / (k - 1)
    within = float(((values - mean[group]) ** 2).sum()) / (count - k)
    usual = (count - float((size**2).sum()) / count) / (k - 1)
    return (between - within) / (between + (usual - 1.0) * within)

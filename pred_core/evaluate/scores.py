"""Scores of one episode, and their statistics over episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pred_core import metrics
from pred_core.evaluate.bootstrap import bootstrap_interval
from pred_core.evaluate.protocol import FIRST_PREDICTED, diverged_at
from pred_core.types import Array, Episode

REPORT_STEP = 30  # "at step 30" (PGND); shorter episodes have no such value
CLOUD_EVERY = 10  # cloud distances are taken at every tenth step: matching is dear and neighbours in time agree


@dataclass(frozen=True)
class Metric:
    """What a metric's name means."""

    unit: str
    meaning: str


CORRESPONDENCE = {
    "mde": Metric("m", "mean L2 distance of corresponding particles, held ones included"),
    "coordinate_l1": Metric("m", "mean absolute error per coordinate, held particles included (cable protocol)"),
}
CLOUD = {
    "chamfer_two_sided_unsquared": Metric("m", "mean_p min_q |p-q| + mean_q min_p |p-q|"),
    "chamfer_one_sided_unsquared": Metric("m", "mean over predicted points of the distance to the nearest measured"),
    "chamfer_two_sided_squared": Metric("m^2", "the two-sided form with squared distances"),
    "emd": Metric("m", "mean unsquared distance of the minimum-cost matching"),
}
METRICS: dict[str, Metric] = {**CORRESPONDENCE, **CLOUD}
_CLOUD_FUNCTION: dict[str, Callable[[Array, Array], float]] = {
    "chamfer_two_sided_unsquared": metrics.chamfer_two_sided,
    "chamfer_one_sided_unsquared": metrics.chamfer_one_sided,
    "chamfer_two_sided_squared": metrics.chamfer_two_sided_squared,
    "emd": metrics.emd,
}


@dataclass(frozen=True)
class EpisodeScore:
    """One prediction scored. Curves are (T-2,) over steps 1, 2, ...; NaN where not taken or nothing was measured."""

    name: str
    curves: Mapping[str, Array]
    diverged: int | None  # step at which the prediction became unusable
    hidden: int  # particle-frames left out


def score_episode(prediction: Array, episode: Episode) -> EpisodeScore:
    """Every metric at every step it is taken at. A diverged episode has no curves: it is reported, not averaged."""
    measured = episode.position[FIRST_PREDICTED:]
    visible = episode.tracks.visible[FIRST_PREDICTED:]
    hidden = metrics.hidden_count(measured, visible)
    diverged = diverged_at(prediction)
    if diverged is not None:
        return EpisodeScore(episode.name, {}, diverged, hidden)
    curves = {
        "mde": metrics.mde(prediction, measured, visible),
        "coordinate_l1": metrics.coordinate_l1(prediction, measured, visible),
    }
    curves.update({name: np.full(len(measured), np.nan) for name in CLOUD})
    seen = metrics.scored(measured, visible)
    for t in range(CLOUD_EVERY - 1, len(measured), CLOUD_EVERY):
        if seen[t].any():
            for name, distance in _CLOUD_FUNCTION.items():
                curves[name][t] = distance(prediction[t], measured[t][seen[t]])
    return EpisodeScore(episode.name, curves, None, hidden)


def at_step(score: EpisodeScore, metric: str, step: int = REPORT_STEP) -> float:
    """Value at a step (1 = first predicted frame), NaN if there is none."""
    curve = score.curves[metric]
    return float(curve[step - 1]) if len(curve) >= step else float("nan")


def over_steps(score: EpisodeScore, metric: str) -> float:
    """Mean over all steps at which the metric was taken, NaN if nothing was measured."""
    curve = score.curves[metric]
    taken = curve[np.isfinite(curve)]
    return float(taken.mean()) if len(taken) else float("nan")


def statistics(values: Mapping[str, float], generator: np.random.Generator) -> dict[str, Any]:
    """Mean, std (of a sample), 95 % interval, median, number and values of episodes; NaN values are left out.

    The interval is null for a single episode, everything but the count for none.
    """
    kept = {name: value for name, value in values.items() if np.isfinite(value)}
    found = np.array(list(kept.values()))
    low, high = bootstrap_interval(found, generator) if len(found) > 1 else (None, None)
    return {
        "mean": float(found.mean()) if len(found) else None,
        "std": float(found.std(ddof=1)) if len(found) > 1 else None,
        "low_95": low,
        "high_95": high,
        "median": float(np.median(found)) if len(found) else None,
        "episodes": len(found),
        "per_episode": kept,
    }


def metrics_table(scores: Sequence[EpisodeScore], seed: int) -> dict[str, Any]:
    """Statistics of every metric over episodes that did not diverge. Each bootstrap is drawn from `seed`."""
    return {
        name: {
            "unit": metric.unit,
            f"step_{REPORT_STEP}": statistics({s.name: at_step(s, name) for s in scores}, np.random.default_rng(seed)),
            "all_steps": statistics({s.name: over_steps(s, name) for s in scores}, np.random.default_rng(seed)),
        }
        for name, metric in METRICS.items()
    }

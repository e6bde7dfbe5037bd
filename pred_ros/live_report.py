"""What the evaluator writes: metrics.json with the entries of `pred evaluate`, and a page to look at.

Scores come from the functions that `pred evaluate` uses, so the same predictions give the same numbers.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from pred_core.errors import ConfigError, InputError
from pred_core.evaluate.models import NamedTwin, twin_models
from pred_core.evaluate.protocol import FIRST_PREDICTED
from pred_core.evaluate.scores import EpisodeScore, metrics_table, over_steps, score_episode
from pred_core.live.scoring import Scored
from pred_core.report.animation import Track, animation
from pred_core.report.page import Page, number
from pred_core.twin import Twin
from pred_core.types import Episode, Grip, ObjectInfo, Tracks

SEED = 0  # of the bootstrap
MOST_NAMED = 14  # episodes in the legend of the curves


@dataclass(frozen=True)
class LiveScore:
    """One episode and its curves over steps 1, 2, ... (T-2,); NaN where no prediction came."""

    episode: Scored
    score: EpisodeScore

    def mean(self, metric: str) -> float:
        """Over all scored steps."""
        return over_steps(self.score, metric)


@dataclass(frozen=True)
class Summary:
    """What a user is told."""

    line: str
    lost: int


def score(episode: Scored) -> LiveScore:
    """Every metric at every step that was predicted. Raises: InputError if there is none."""
    use = FIRST_PREDICTED + np.flatnonzero(episode.scorable[FIRST_PREDICTED:])
    if not len(use):
        raise InputError(f"{episode.name}: nothing to score, no prediction matches a measured frame")
    frames = np.concatenate([np.arange(FIRST_PREDICTED), use])
    found = score_episode(episode.predicted[use], _episode(episode, frames))
    curves = {name: np.full(len(episode.stamps) - FIRST_PREDICTED, np.nan) for name in found.curves}
    for name, values in found.curves.items():
        curves[name][use - FIRST_PREDICTED] = values
    return LiveScore(episode, EpisodeScore(episode.name, curves, found.diverged, found.hidden))


def stage_name(twin: Twin) -> str:
    """What a twin is called when it predicts in full: spring-mass, extended or pred, as `pred evaluate` says."""
    return twin_models(NamedTwin("", twin))[-1].name


def write_results(episodes: Sequence[Scored], model: str, out: Path, released: int = 0) -> Summary:
    """Write `metrics.json` and `report.html` into `out`. Episodes without a prediction are listed, not averaged.

    `released`: earlier episodes of a long replay that the scores do not cover.

    Raises: InputError if no episode can be scored; ConfigError if the folder cannot be written.
    """
    usable = [e for e in episodes if e.scorable[FIRST_PREDICTED:].any()]
    if not usable:
        raise InputError(
            "nothing to score: no prediction matches a measured frame", next_step="Is the predictor running?"
        )
    scores = [score(e) for e in usable]
    lost = sum(e.lost for e in episodes)
    silent = [e.name for e in episodes if e not in usable]
    values = {
        "source": "live",
        "entries": [_entry(model, s, [x for x in scores if x.episode.split == s]) for s in _splits(scores)],
        "frames": {"announced": sum(e.announced for e in episodes), "lost": lost},
        "episodes_without_prediction": silent,
        "episodes_released": released,
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "metrics.json").write_text(json.dumps(values, indent=2), encoding="utf-8")
        _page(scores, values, model).write(out / "report.html")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written", got=error) from error
    l1, mde = (float(np.mean([s.mean(m) for s in scores])) for m in ("coordinate_l1", "mde"))
    line = (
        f"{model}, live, {len(scores)} episodes: coordinate_l1 {1e2 * l1:.3f} cm, mde {1e3 * mde:.2f} mm, "
        f"{lost} frames lost; {out / 'report.html'}"
    )
    return Summary(line, lost)


def _splits(scores: Sequence[LiveScore]) -> list[str]:
    return list(dict.fromkeys(s.episode.split for s in scores))


def _entry(model: str, split: str, scores: Sequence[LiveScore]) -> dict[str, Any]:
    table = metrics_table([s.score for s in scores], SEED)
    return {"model": model, "split": split, "episodes_tested": len(scores), "metrics": table}


def _episode(live: Scored, frames: np.ndarray) -> Episode:
    """The measured side of some frames as the type that is scored."""
    measured = live.measured[frames]
    seen = np.isfinite(measured).all(-1)
    tracks = Tracks(live.stamps[frames], measured, live.id, seen, seen.astype(np.float32))
    none = torch.zeros(len(frames), 0)
    grips = Grip(none[..., None].expand(-1, -1, 3), none[..., None].expand(-1, -1, 4), none.bool())
    free = np.full(len(live.id), -1, np.int32)
    return Episode(live.name, ObjectInfo(), tracks.stamp, tracks, grips, free, live.split, live.recording)


def _page(scores: Sequence[LiveScore], values: dict[str, Any], model: str) -> Page:
    page = Page("Live prediction, scored")
    frames = values["frames"]
    page.text(
        f"Model '{model}' over ROS 2 topics: {len(scores)} episodes, open loop from the first two frames, driven by "
        f"the measured gripper. {frames['lost']} of {frames['announced']} announced frames were lost."
    )
    if values["episodes_without_prediction"]:
        page.text("Without any prediction: " + ", ".join(values["episodes_without_prediction"]))
    if values["episodes_released"]:
        page.text(f"{values['episodes_released']} earlier episodes are not covered: the newest were kept.")
    page.figure(_curves(scores), "Mean distance error of every episode against time since its start")
    ranked = sorted(scores, key=lambda s: s.mean("mde"))
    for kind, shown in (("median", ranked[len(ranked) // 2]), ("worst", ranked[-1])):
        page.heading(f"The {kind} episode: {shown.episode.name}")
        measured = Track("measured", shown.episode.measured[FIRST_PREDICTED:], "#1b1f24")
        predicted = Track("predicted", shown.episode.predicted[FIRST_PREDICTED:], "#d9480f")
        period = float(np.median(np.diff(shown.episode.stamps))) * 1e-9
        title = f"{shown.episode.name}, measured and predicted."
        page.html(animation([measured, predicted], period, line=shown.episode.line, title=title))
    page.heading("Every episode")
    header = ("episode", "split", "coordinate_l1 [cm]", "mde [mm]", "chamfer_two_sided_unsquared [mm]", "lost frames")
    page.table(header, [_row(s) for s in scores], ["warn" if s.episode.lost else "" for s in scores])
    return page


def _row(s: LiveScore) -> tuple[object, ...]:
    l1, mde, chamfer = (s.mean(m) for m in ("coordinate_l1", "mde", "chamfer_two_sided_unsquared"))
    return s.episode.name, s.episode.split, number(1e2 * l1), number(1e3 * mde), number(1e3 * chamfer), s.episode.lost


def _curves(scores: Sequence[LiveScore]) -> Figure:
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    for s in scores:
        seconds = (s.episode.stamps[FIRST_PREDICTED:] - s.episode.stamps[FIRST_PREDICTED - 1]) * 1e-9
        axes.plot(seconds, 1e3 * s.score.curves["mde"], linewidth=0.8, alpha=0.7, label=s.episode.name)
    axes.set(xlabel="time since the start [s]", ylabel="mde [mm]")
    axes.spines[["top", "right"]].set_visible(False)
    if len(scores) <= MOST_NAMED:
        axes.legend(fontsize=7, ncols=2, frameon=False)
    return figure

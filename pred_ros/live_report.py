"""What the evaluator writes: metrics.json in the layout of `pred evaluate`, and a page to look at."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from pred_core.errors import ConfigError, InputError
from pred_core.metrics.chamfer import chamfer_two_sided
from pred_core.metrics.correspondence import coordinate_l1, mde, scored
from pred_core.types import Array
from pred_ros.scoring import FIRST_PREDICTED, Scored

STEP = 30  # the early step that is reported beside the mean over all


@dataclass(frozen=True)
class EpisodeScore:
    """Errors of one episode over its predicted frames, each (T-2,) [m]; NaN where nothing came."""

    episode: Scored
    curves: dict[str, Array]

    def mean(self, metric: str) -> float:
        """Over all scored frames [m]."""
        return float(np.nanmean(self.curves[metric]))


@dataclass(frozen=True)
class Summary:
    """What a user is told."""

    line: str
    lost: int


def score(episode: Scored) -> EpisodeScore:
    """Metrics by their full variant names. Raises: InputError if the episode has no pair."""
    use = episode.scorable[FIRST_PREDICTED:]
    if not use.any():
        raise InputError(f"{episode.name}: nothing to score, no prediction matches a measured frame")
    measured, predicted = episode.measured[FIRST_PREDICTED:], episode.predicted[FIRST_PREDICTED:]
    curves = {}
    for name, function in (("mde", mde), ("coordinate_l1", coordinate_l1)):
        curve = np.full(len(use), np.nan)
        curve[use] = function(predicted[use], measured[use])
        curves[name] = curve
    chamfer = np.full(len(use), np.nan)
    for t in np.flatnonzero(use):
        seen = scored(measured[t])
        if seen.any():
            chamfer[t] = chamfer_two_sided(predicted[t][seen], measured[t][seen])
    curves["chamfer_two_sided_unsquared"] = chamfer
    return EpisodeScore(episode, curves)


def write_results(episodes: Sequence[Scored], model: str, out: Path) -> Summary:
    """Write `metrics.json` and `report.html` into `out`. Episodes without a pair are listed as lost.

    Raises: InputError if no episode can be scored; ConfigError if the folder cannot be written.
    """
    usable = [e for e in episodes if e.scorable[FIRST_PREDICTED:].any()]
    if not usable:
        raise InputError(
            "nothing to score: no prediction matches a measured frame", next_step="Is the predictor running?"
        )
    scores = [score(e) for e in usable]
    lost = sum(e.lost for e in episodes)
    values = {
        "source": "live",
        "models": {
            model: {split: _entry([s for s in scores if s.episode.split == split]) for split in _splits(scores)}
        },
        "frames": {"announced": sum(e.announced for e in episodes), "lost": lost},
        "episodes_without_prediction": [e.name for e in episodes if e not in usable],
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "metrics.json").write_text(json.dumps(values, indent=2), encoding="utf-8")
        (out / "report.html").write_text(_page(scores, values, model), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written", got=error) from error
    mean_l1 = 1e2 * float(np.mean([s.mean("coordinate_l1") for s in scores]))
    mean_mde = 1e3 * float(np.mean([s.mean("mde") for s in scores]))
    line = (
        f"{model}, live, {len(scores)} episodes: coordinate_l1 {mean_l1:.3f} cm, mde {mean_mde:.2f} mm, "
        f"{lost} frames lost; {out / 'report.html'}"
    )
    return Summary(line, lost)


def _splits(scores: Sequence[EpisodeScore]) -> list[str]:
    return list(dict.fromkeys(s.episode.split for s in scores))


def _entry(scores: Sequence[EpisodeScore]) -> dict[str, Any]:
    entry: dict[str, Any] = {}
    for metric in scores[0].curves:
        means = np.array([s.mean(metric) for s in scores])
        early = np.array([s.curves[metric][STEP - 1] if len(s.curves[metric]) >= STEP else np.nan for s in scores])
        at_step = float(np.mean(early)) if np.isfinite(early).all() else None
        entry[metric] = {
            "unit": "m",
            "all": {"mean": float(means.mean()), "std": float(means.std()), "episodes": len(scores)},
            f"step_{STEP}": {"mean": at_step},
            "per_episode": {s.episode.name: float(m) for s, m in zip(scores, means, strict=True)},
        }
    return entry


def _page(scores: Sequence[EpisodeScore], values: dict[str, Any], model: str) -> str:
    ranked = sorted(scores, key=lambda s: s.mean("mde"))
    shown = {"median": ranked[len(ranked) // 2], "worst": ranked[-1]}
    return jinja2.Environment(autoescape=True).from_string(_TEMPLATE).render(
        model=model,
        frames=values["frames"],
        rows=[
            (s.episode.name, s.episode.split, f"{1e2 * s.mean('coordinate_l1'):.3f}", f"{1e3 * s.mean('mde'):.2f}",
             f"{1e3 * s.mean('chamfer_two_sided_unsquared'):.2f}", s.episode.lost)
            for s in scores
        ],
        curve=_picture(_curves(scores)),
        pictures=[(kind, s.episode.name, _picture(_overlay(s))) for kind, s in shown.items()],
    )  # fmt: skip


def _curves(scores: Sequence[EpisodeScore]) -> Figure:
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    for s in scores:
        seconds = (s.episode.stamps[FIRST_PREDICTED:] - s.episode.stamps[1]) * 1e-9
        axes.plot(seconds, 1e3 * s.curves["mde"], linewidth=0.8, alpha=0.7)
    axes.set(xlabel="time since the start [s]", ylabel="mean distance error [mm]", title="Every episode, open loop")
    return figure


def _overlay(s: EpisodeScore) -> Figure:
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    axes = figure.subplots(1, 4)
    frames = np.flatnonzero(s.episode.scorable)
    for ax, t in zip(axes, frames[np.linspace(0, len(frames) - 1, 4).astype(int)], strict=True):
        for points, style, label in (
            (s.episode.measured[t], "ko-", "measured"),
            (s.episode.predicted[t], "C1o-", "predicted"),
        ):
            ax.plot(points[:, 0], points[:, 2], style, markersize=3, linewidth=1, label=label)
        seconds = (s.episode.stamps[t] - s.episode.stamps[0]) * 1e-9
        ax.set(title=f"{seconds:.2f} s", xlabel="x [m]", aspect="equal")
    axes[0].set_ylabel("z [m]")
    axes[0].legend(fontsize=7)
    return figure


def _picture(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


_TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Live prediction, scored</title>
<style>body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#1c2330}
table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:right;border-bottom:1px solid #dde}
td:first-child,th:first-child{text-align:left}img{max-width:100%}</style></head><body>
<h1>Live prediction, scored</h1>
<p>Model <b>{{ model }}</b>, {{ rows|length }} episodes over ROS 2 topics, open loop from the first two frames,
driven by the measured gripper. {{ frames.lost }} of {{ frames.announced }} announced frames were lost.</p>
<img src="data:image/png;base64,{{ curve }}" alt="error against time">
{% for kind, name, picture in pictures %}<h2>The {{ kind }} episode, {{ name }}</h2>
<img src="data:image/png;base64,{{ picture }}" alt="measured and predicted">{% endfor %}
<h2>Every episode</h2>
<table><tr><th>episode</th><th>split</th><th>coordinate_l1 [cm]</th><th>mde [mm]</th>
<th>chamfer_two_sided_unsquared [mm]</th><th>lost frames</th></tr>
{% for row in rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</table>
</body></html>
"""

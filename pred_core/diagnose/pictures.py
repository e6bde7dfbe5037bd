"""Pictures of an answer: evidence, errors by episode, the error budget, stills of one episode."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from pred_core.diagnose.evidence import Judged
from pred_core.diagnose.pictures_map import COLORS
from pred_core.diagnose.progress import Round
from pred_core.diagnose.result import Errors
from pred_core.evaluate.bootstrap import bootstrap_interval
from pred_core.evaluate.style import GREY, GRID, INK, tidy
from pred_core.types import Array

NAMED = ("#009E73", "#0072B2", "#CC79A7", "#56B4E9", "#5D3A9B", "#1b9e9e", "#8C564B", "#B07C00")
LEARNED, UNEXPLAINED, FLOOR, OTHER = "#E6B800", "#D55E00", "#b8c0c8", "#7a7a7a"
MOST_LABELS = 60
LITTLE = 0.05  # of the base's loss: a smaller excess is nothing to take shares of


def whole_of(seen: Round) -> tuple[float, str]:
    """What gains are shares of: the excess over the reference, or the base's loss where there is next to no excess."""
    base = float(seen.base.mean())
    excess = base - seen.floor
    if excess > LITTLE * base:
        return excess, "the base's mean excess loss"
    return max(base, 1e-9), "the base's mean loss, which exceeds the reference's by next to nothing"


def evidence(seen: Round, words: dict[str, str], named: Judged | None, seed: int) -> Figure:
    """What each fitted candidate saves on episodes it did not see, as share of `whole_of`; dots are episodes."""
    judged = sorted((j for j, _, _ in seen.judged), key=lambda j: j.mean)
    excess, of = whole_of(seen)
    figure = Figure(figsize=(9.5, 1.1 + 0.36 * len(judged)), layout="constrained")
    axes = figure.subplots()
    axes.axvline(0.0, color=GREY, linewidth=0.9)
    axes.axvline(100.0, color=GREY, linewidth=0.9, linestyle=":")
    for n, j in enumerate(judged):
        gain = 100.0 * j.gain / excess
        color = COLORS["extended"] if j is named else GREY
        axes.scatter(gain, np.full(len(gain), n), s=9, color=color, alpha=0.35, linewidths=0)
        low, high = (gain[0], gain[0]) if len(gain) < 2 else bootstrap_interval(gain, np.random.default_rng(seed))
        axes.plot((low, high), (n, n), color=color, linewidth=2.2, solid_capstyle="butt")
        axes.scatter([gain.mean()], [n], s=34, color=color, zorder=3)
    axes.set_yticks(range(len(judged)), [words.get(j.trial.id, j.trial.id) for j in judged])
    axes.set_ylim(-0.6, len(judged) - 0.4)
    every = 100.0 * np.concatenate([j.gain for j in judged]) / excess
    axes.set_xlim(max(float(every.min()) - 5.0, -150.0), min(float(every.max()) + 5.0, 400.0))
    tidy(axes, f"saved on the episodes it is judged on\n[% of {of}]", "")
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", colors=INK)
    return figure


def by_episode(parts: Sequence[Errors]) -> Figure:
    """Every episode's error before and after, one panel a split, in the order of the base's error."""
    rows = max(len(p.base.names) for p in parts)
    figure = Figure(figsize=(5.2 * len(parts) + 1.0, 1.4 + 0.26 * min(rows, MOST_LABELS)), layout="constrained")
    grid = figure.subplots(1, len(parts), squeeze=False, sharex=True)[0]
    for axes, part in zip(grid, parts, strict=True):
        order = np.argsort(part.base.values)
        before, after = part.base.values[order], part.extended.values[order]
        y = np.arange(len(order))
        axes.hlines(y, np.minimum(before, after), np.maximum(before, after), color=GRID, linewidth=3)
        axes.scatter(before, y, s=26, color=COLORS["base"], label="base", zorder=3)
        if not np.array_equal(before, after):
            axes.scatter(after, y, s=26, marker="s", color=COLORS["extended"], label="extended", zorder=4)
        if part.floor is not None:
            axes.axvline(part.floor, color=COLORS["reference"], linestyle="--", linewidth=1.2, label="reference (mean)")
        names = [part.base.names[k] for k in order]
        axes.set_yticks(y, names if len(names) <= MOST_LABELS else [""] * len(names), fontsize=8)
        axes.set_ylim(-0.6, len(names) - 0.4)
        axes.set_title(part.split, loc="left", fontsize=11, fontweight="bold", color=INK)
        tidy(axes, "mean error over the whole episode [mm]", "")
        axes.grid(False, axis="y")
    grid[0].set_xlim(left=0.0)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure


def budget_bar(rows: Sequence[tuple[str, float, str]]) -> Figure:
    """One stacked bar of (name, mm, color); what makes the error larger stands left of zero."""
    figure = Figure(figsize=(11, 1.9), layout="constrained")
    axes = figure.subplots()
    right = left = 0.0
    whole = sum(abs(v) for _, v, _ in rows) or 1.0
    for name, value, color in rows:
        if value == 0.0:
            continue
        begin = right if value > 0 else left
        axes.barh(0.0, value, left=begin, height=0.6, color=color, edgecolor="white", linewidth=1.5,
                  hatch=None if value > 0 else "///", label=f"{name} {value:.1f}")  # fmt: skip
        if abs(value) > 0.05 * whole:
            axes.text(begin + value / 2, 0.0, f"{value:.1f}", ha="center", va="center", fontsize=10, color="white",
                      fontweight="bold")  # fmt: skip
        right, left = right + max(value, 0.0), left + min(value, 0.0)
    axes.set_yticks(())
    axes.set_ylim(-0.45, 0.45)
    axes.set_xlim(left * 1.02, max(right * 1.02, 1e-3))
    axes.spines["left"].set_visible(False)
    tidy(axes, "held-out error of the base [mm]", "")
    figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    return figure


def stills(tracks: Sequence[tuple[str, Array, str]], period: float, line: bool) -> Figure:
    """Shapes (name, (T, N, 3) [m], color) at five times, from the side and from above."""
    measured = tracks[0][1]
    times = np.linspace(0, len(measured) - 1, 6).round().astype(int)[1:]
    flat = measured[np.isfinite(measured).all(axis=-1)]
    _, vectors = np.linalg.eigh(np.cov(flat[:, :2].T))
    side = np.append(vectors[:, 1], 0.0)
    views = (("side", side, np.array([0.0, 0.0, 1.0])), ("above", np.eye(3)[0], np.eye(3)[1]))
    labels = {"side": ("sideways [m]", "z [m]"), "above": ("x [m]", "y [m]")}
    figure = Figure(figsize=(13, 5.4), layout="constrained")
    grid = figure.subplots(2, 5, sharex="row", sharey="row")
    for row, (view, right, up) in zip(grid, views, strict=True):
        spans = []
        for axes, t in zip(row, times, strict=True):
            for n, (name, position, color) in enumerate(tracks):
                points = np.column_stack((position[t] @ right, position[t] @ up))
                spans.append(points)
                axes.plot(*points.T, "o-" if line else ".", color=color, linewidth=3.0 if n == 0 else 1.5,
                          markersize=2.5, alpha=0.5 if n == 0 else 1.0, label=name)  # fmt: skip
            axes.set_aspect("equal", adjustable="box")
            axes.set_title(f"{(t + 1) * period:.2f} s", fontsize=9, color=GREY)
            across, upward = labels[view]
            tidy(axes, across, upward if axes is row[0] else "")
        every = np.concatenate(spans)
        low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
        middle, half = (low + high) / 2, 0.55 * float((high - low).max())
        row[0].set_xlim(middle[0] - half, middle[0] + half)
        row[0].set_ylim(middle[1] - half, middle[1] + half)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names), frameon=False, fontsize=10)
    return figure

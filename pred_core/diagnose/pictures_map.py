"""Pictures of the map: the error against what may explain it, seen from above, and its direction along the object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pred_core.diagnose.map import FEATURES, Above, Curve, Feature, Replay, conditional, edges_of, from_above, grid_of
from pred_core.diagnose.map import pull_along as along
from pred_core.evaluate.style import GREY, GRID, INK, tidy
from pred_core.types import Array

COLORS = {"base": "#D55E00", "extended": "#009E73", "reference": "#56707f"}
DASHES = {"base": "-", "extended": "-", "reference": "--"}
MARKS = {"base": "o", "extended": "s", "reference": "^"}
AXES = ("x", "y", "z")


def curves(replays: Sequence[Replay], seed: int) -> Figure:
    """Mean error against each feature, one line a replay."""
    shown = [f for f in FEATURES if f.key in replays[0].features and len(edges_of(replays[0], f.key)) > 1]
    rows = -(-len(shown) // 4)
    figure = Figure(figsize=(13, 3.0 * rows), layout="constrained")
    grid = figure.subplots(rows, 4, sharey=True, squeeze=False)
    highest = 1e-3  # a wide band of a thin bin may leave the picture, no mean does
    for axes, feature in zip(grid.flat, shown, strict=False):
        edges = edges_of(replays[0], feature.key)
        for r in replays:
            # The clocks of two sessions have nothing in common.
            own = edges_of(r, feature.key) if feature.key == "session" else edges
            curve = conditional(r, feature.key, own, np.random.default_rng(seed))
            highest = max(highest, 1.35 * float(np.nanmax(curve.mean, initial=0.0)))
            _bars(axes, curve, r.name) if feature.key == "contact" else _line(axes, curve, r.name)
        _label(axes, feature)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for row in grid:
        row[0].set_ylabel("mean error [mm]", color=INK)
    grid[0, 0].set_ylim(0.0, highest)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=10)
    return figure


def _line(axes: Axes, curve: Curve, name: str) -> None:
    drawn = np.isfinite(curve.mean)
    axes.fill_between(curve.center[drawn], curve.low[drawn], curve.high[drawn], color=COLORS[name], alpha=0.15, lw=0)
    axes.plot(curve.center[drawn], curve.mean[drawn], DASHES[name], color=COLORS[name], marker=MARKS[name],
              markersize=3.5, linewidth=1.6, label=name)  # fmt: skip


def _bars(axes: Axes, curve: Curve, name: str) -> None:
    drawn = np.isfinite(curve.mean)
    shift = {"base": -0.06, "extended": 0.06, "reference": 0.0}[name]
    spread = np.stack((curve.mean - curve.low, curve.high - curve.mean))[:, drawn]
    axes.errorbar(curve.center[drawn] + shift, curve.mean[drawn], spread, fmt=MARKS[name], color=COLORS[name],
                  markersize=5, capsize=3, linewidth=1.6, label=name)  # fmt: skip


def _label(axes: Axes, feature: Feature) -> None:
    tidy(axes, feature.label, "")
    if feature.key == "contact":
        axes.set_xticks((0.0, 1.0), ("in the air", "touching"))
        axes.set_xlim(-0.5, 1.5)


def seen_from_above(replays: Sequence[Replay]) -> Figure:
    """Mean error where the object was, and its mean horizontal direction, one panel a replay."""
    x, y = grid_of(replays)
    maps = [from_above(r, x, y) for r in replays]
    # One bad cell must not make all others pale.
    own = [m for m, r in zip(maps, replays, strict=True) if r.name != "reference"]
    most = float(np.nanquantile(np.concatenate([m.mean.ravel() for m in own]), 0.97))
    pulls = np.concatenate([m.pull.reshape(-1, 2) for m in own])
    longest = float(np.nanquantile(np.linalg.norm(pulls, axis=-1), 0.95))
    height = 1.2 + 3.9 * min(max(np.ptp(y) / np.ptp(x), 0.45), 1.6)
    figure = Figure(figsize=(4.2 * len(maps) + 0.8, height), layout="constrained")
    grid = figure.subplots(1, len(maps), sharex=True, sharey=True, squeeze=False)[0]
    for axes, one, r in zip(grid, maps, replays, strict=True):
        image = axes.pcolormesh(x, y, one.mean, cmap="YlOrBr", vmin=0.0, vmax=max(most, 1e-3), edgecolors="face",
                                linewidth=0.1)  # fmt: skip
        _arrows(axes, one, longest, x[1] - x[0])
        axes.set_aspect("equal", adjustable="box")
        axes.set_title(r.name, loc="left", fontsize=11, fontweight="bold", color=INK)
        tidy(axes, "x [m]", "y [m]" if axes is grid[0] else "")
    bar = figure.colorbar(image, ax=list(grid), shrink=0.85, pad=0.015, extend="max")
    bar.set_label("mean error [mm]", color=INK)
    bar.outline.set_edgecolor(GRID)  # type: ignore[operator]
    return figure


def _arrows(axes: Axes, one: Above, usual: float, side: float) -> None:
    """Mean of measured minus predicted, `usual` [mm] as long as 1.3 cells, the longest two cells."""
    xs, ys = np.meshgrid((one.x[1:] + one.x[:-1]) / 2, (one.y[1:] + one.y[:-1]) / 2)
    length = np.linalg.norm(one.pull, axis=-1, keepdims=True)
    scale = 1.3 * side / max(usual, 1e-9)
    with np.errstate(invalid="ignore", divide="ignore"):
        drawn = one.pull / length * np.minimum(length * scale, 2.0 * side)
    axes.quiver(xs, ys, drawn[..., 0], drawn[..., 1], angles="xy", scale_units="xy", scale=1.0, pivot="mid", color=INK,
                width=0.005, alpha=0.85)  # fmt: skip
    axes.set_title(f"an arrow of one cell: {usual / 1.3:.1f} mm", loc="right", fontsize=8, color=GREY)


def direction(replays: Sequence[Replay], arc: Array) -> Figure:
    """Mean of measured minus predicted along the object, one panel a world axis. arc (N,)."""
    figure = Figure(figsize=(13, 2.7), layout="constrained")
    grid = figure.subplots(1, 3, sharey=True)
    for k, axes in enumerate(grid):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        for r in replays:
            axes.plot(np.sort(arc), along(r, arc)[:, k], DASHES[r.name], color=COLORS[r.name], marker=MARKS[r.name],
                      markersize=3, label=r.name)  # fmt: skip
        axes.set_title(AXES[k], loc="left", fontsize=11, fontweight="bold", color=INK)
        tidy(axes, "place along the object", "measured - predicted [mm]" if k == 0 else "")
    grid[0].legend(frameon=False, fontsize=9)
    return figure

"""The figures of the evaluation report. Every function returns a matplotlib Figure; lengths are printed in cm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pred_core.evaluate.evaluation import Result
from pred_core.evaluate.protocol import FIRST_PREDICTED
from pred_core.evaluate.style import GREY, INK, styles, tidy
from pred_core.evaluate.where import error_by_speed, error_map, error_spectrum
from pred_core.types import Array

CM = 100.0  # [cm/m]


def error_against_time(results: Sequence[Result], main: str) -> Figure:
    """Mean error per coordinate over episodes against time; the band of `main` holds the middle half of them."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    axes = figure.subplots()
    look = styles([r.model.name for r in results])
    highest = 0.0
    for result in results:
        curves = _curves(result)
        if not len(curves):
            continue
        time = np.arange(1, curves.shape[1] + 1) * result.episodes[0].period
        mean = np.nanmean(curves, axis=0) * CM
        name = result.model.name
        color, dash = look[name]
        if name != "constant-velocity":  # it leaves the picture within a second and would set the scale
            highest = max(highest, float(np.nanmax(mean)))
        axes.plot(time, mean, dash, color=color, linewidth=2.4 if name == main else 1.5, label=name)
        if name == main and len(curves) > 3:
            low, high = np.nanquantile(curves * CM, [0.25, 0.75], axis=0)
            axes.fill_between(time, low, high, color=color, alpha=0.15, linewidth=0)
    axes.set_ylim(0, 1.08 * highest if highest > 0 else 1.0)
    axes.set_xlim(left=0)
    tidy(axes, "time after the start [s]", "mean error per coordinate [cm]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=9)
    return figure


def error_by_episode(results: Sequence[Result], main: Result) -> Figure:
    """Every episode's error under every model, episodes in the order of the main model's error."""
    order = [k for k, _ in sorted(main.values("coordinate_l1").items(), key=lambda item: item[1])]
    figure = Figure(figsize=(9, 4.0), layout="constrained")
    axes = figure.subplots()
    look = styles([r.model.name for r in results])
    highest = 0.0
    for result in results:
        if result.model.name == "constant-velocity":  # far off the scale of every other model
            continue
        values = result.values("coordinate_l1")
        x = [i for i, name in enumerate(order) if name in values]
        y = np.array([values[order[i]] * CM for i in x])
        name = result.model.name
        if len(y):
            highest = max(highest, float(y.max()))
        strong = result is main
        size, alpha, order_z = (34, 1.0, 3) if strong else (15, 0.65, 2)
        axes.scatter(x, y, s=size, color=look[name][0], alpha=alpha, label=name, zorder=order_z)
        if strong and len(y):
            axes.axhline(float(y.mean()), color=look[name][0], linewidth=1)
            axes.axhline(float(np.median(y)), color=look[name][0], linewidth=1, linestyle="--")
    axes.set_ylim(0, 1.05 * highest if highest > 0 else 1.0)
    many = len(order) > 30
    axes.set_xticks(range(len(order)), [] if many else order, rotation=60, ha="right", fontsize=8)
    tidy(axes, f"episodes, ordered by the error of {main.model.name}", "mean error per coordinate [cm]")
    if not many:
        axes.tick_params(axis="x", labelsize=8)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=9)
    return figure


def error_on_object(results: Sequence[Result]) -> Figure:
    """Per particle and direction: mean absolute and signed error; the spectrum of the error; error against speed."""
    figure = Figure(figsize=(12, 2.9 * len(results)), layout="constrained")
    grid = figure.subplots(
        len(results), 4, squeeze=False, sharey="col", gridspec_kw={"width_ratios": (1, 1, 0.75, 0.75)}
    )
    for row, result in zip(grid, results, strict=True):
        predictions, episodes = usable(result)
        where = error_map(predictions, episodes)
        ids = episodes[0].tracks.id
        for k, (direction, color, dash) in enumerate(
            zip(where.directions, ("#0072B2", "#D55E00", "#009E73"), ("-", "--", "-."), strict=True)
        ):
            row[0].plot(ids, where.absolute[:, k] * CM, dash, color=color, marker="o", markersize=3.5, label=direction)
            row[1].plot(ids, where.bias[:, k] * CM, dash, color=color, marker="o", markersize=3.5, label=direction)
        row[1].axhline(0, color=GREY, linewidth=0.8)
        frequency, share = error_spectrum(predictions, episodes)
        row[2].step(frequency, 100 * share, where="post", color=INK)
        row[2].set_xlim(0, 6)
        row[2].set_ylim(0, 103)
        speed, error = error_by_speed(predictions, episodes)
        row[3].plot(speed, error * CM, color=INK, marker="o", markersize=3.5)
        row[3].set_xlim(left=0)
        row[0].set_title(result.model.name, loc="left", fontsize=11, fontweight="bold", color=INK)
        tidy(row[0], "particle id", "mean |error| [cm]")
        tidy(row[1], "particle id", "mean signed error [cm]")
        tidy(row[2], "frequency [Hz]", "squared error below [%]")
        tidy(row[3], "gripper speed [m/s]", "error per coordinate [cm]")
    for column in (0, 3):  # axes of a column are shared: the rows compare
        grid[0, column].set_ylim(bottom=0)
    grid[0, 0].legend(frameon=False, fontsize=8)
    return figure


def shapes(result: Result, episode_name: str, others: Sequence[Result] = ()) -> Figure:
    """Measured and predicted shape of one episode at five times, from the side and from the front."""
    index = [e.name for e in result.episodes].index(episode_name)
    episode = result.episodes[index]
    measured = episode.position[FIRST_PREDICTED:]
    times = np.linspace(0, len(measured) - 1, 5).round().astype(int)
    horizontal = _horizontal_axes(measured)
    look = styles([result.model.name, *(o.model.name for o in others)])
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    grid = figure.subplots(2, 5, sharex="row", sharey="row")
    joined = "o-" if episode.object.kind == "line" else "."
    for row, (axis, label) in zip(grid, zip(horizontal, ("side", "front"), strict=True), strict=True):
        spans: list[Array] = []
        for axes, t in zip(row, times, strict=True):
            layers = [("measured", measured[t], INK, 2.6)]
            for one in (*others, result):
                position = one.predictions[[e.name for e in one.episodes].index(episode_name)][t]
                layers.append((one.model.name, position, look[one.model.name][0], 1.4))
            spans += [np.column_stack((position @ axis, position[:, 2])) for _, position, _, _ in layers]
            for name, position, color, width in layers:
                axes.plot(position @ axis, position[:, 2], joined, color=color, linewidth=width, markersize=2.5,
                          alpha=0.55 if name == "measured" else 1.0, label=name)
            axes.set_aspect("equal", adjustable="box")
            axes.set_title(f"{(t + 1) * episode.period:.2f} s", fontsize=9, color=GREY)
            tidy(axes, f"{label} view [m]", "z [m]" if axes is row[0] else "")
        _square_limits(row[0], np.concatenate(spans))
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=9)
    return figure


def _square_limits(axes: Axes, points: Array) -> None:
    """Equal scale on both axes, everything inside. Points (M, 2), NaN = not drawn."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    center, half = (low + high) / 2, 0.55 * float((high - low).max())
    axes.set_xlim(center[0] - half, center[0] + half)
    axes.set_ylim(center[1] - half, center[1] + half)


def usable(result: Result) -> tuple[list[Array], list]:  # type: ignore[type-arg]
    """Predictions and episodes that did not diverge."""
    kept = [i for i, s in enumerate(result.scores) if s.diverged is None]
    return [result.predictions[i] for i in kept], [result.episodes[i] for i in kept]


def _curves(result: Result) -> Array:
    """(E, T) coordinate_l1 of the episodes of the commonest length [m]."""
    curves = [s.curves["coordinate_l1"] for s in result.scores if s.diverged is None]
    lengths = [len(c) for c in curves]
    common = max(set(lengths), key=lengths.count) if lengths else 0
    return np.array([c for c in curves if len(c) == common])


def _horizontal_axes(position: Array) -> tuple[Array, Array]:
    """Horizontal unit vectors of largest and of least extent, each (3,)."""
    flat = position.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1), :2]
    _, vectors = np.linalg.eigh(np.cov(flat.T))
    return np.append(vectors[:, 1], 0.0), np.append(vectors[:, 0], 0.0)

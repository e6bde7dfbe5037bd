"""Pictures of trials: share through and chamfer distance against time, ropes from above."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pred_core.plant.live.slot import SlotConfig
from pred_core.types import Array

COLORS = {"pred": "#009E73", "spring-mass": "#D55E00"}
OTHER = "#0072B2"
GRID = 0.4  # [s] of the curves


def curve(trials: Sequence[dict[str, Any]]) -> tuple[Array, Array]:
    """Times (T,) [s] and the median chamfer distance (T,) [mm]; a trial that ended keeps its last value."""
    longest = max(t["chamfer"][-1][0] for t in trials)
    times = np.arange(0.0, longest + 0.5 * GRID, GRID)
    values = [np.interp(times, *np.array(t["chamfer"]).T) for t in trials]
    return times, 1e3 * np.median(values, axis=0)


def settings_of(groups: dict[str, Any]) -> dict[str, list[str]]:
    """What differs beside the twin -> the folders."""
    found: dict[str, list[str]] = {}
    for name in groups:
        found.setdefault(_setting(name), []).append(name)
    return found


def panels(groups: dict[str, Any], height: float) -> tuple[Figure, list[tuple[Any, str, list[str]]]]:
    """A figure `height` inches high, and of each of its panels axes, what it shows and the folders of it."""
    settings = settings_of(groups)
    figure = Figure(figsize=(5.5 * len(settings), height), layout="constrained")
    row = figure.subplots(1, len(settings), squeeze=False)[0]
    return figure, [(axes, title, names) for axes, (title, names) in zip(row, settings.items(), strict=True)]


def shares(groups: dict[str, list[dict[str, Any]]]) -> Figure:
    """Through by when; one panel for what differs beside the twin."""
    figure, parts = panels(groups, 3.0)
    for axes, title, names in parts:
        for name in names:
            longest = max(t["chamfer"][-1][0] for t in groups[name])
            times = sorted(t["time"] for t in groups[name] if t["success"])
            steps = np.arange(len(times) + 1) / len(groups[name])
            line = [0.0, *times, max([longest, *times])], [*steps, steps[-1]]
            label = f"{_twin(name)}, {len(groups[name])} trials"
            axes.step(*line, where="post", color=COLORS.get(_twin(name), OTHER), linewidth=2, label=label)
        axes.set(xlabel="time [s]", ylabel="share through", title=title, ylim=(0.0, 1.02))
        axes.legend(frameon=False)
    return figure


def curves(groups: dict[str, list[dict[str, Any]]]) -> Figure:
    """One panel for what differs beside the twin."""
    figure, parts = panels(groups, 3.6)
    for axes, title, names in parts:
        for name in names:
            color = COLORS.get(_twin(name), OTHER)
            for trial in groups[name]:
                axes.plot(*(np.array(trial["chamfer"]) * [1.0, 1e3]).T, color=color, alpha=0.2, linewidth=0.8)
            axes.plot(*curve(groups[name]), color=color, linewidth=2.2, label=_twin(name))
        axes.set(xlabel="time [s]", ylabel="chamfer distance to the goal [mm]", title=title)
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False)
    return figure


def views(groups: dict[str, list[dict[str, Any]]], most: int = 6) -> Figure:
    """Ropes from above."""
    figure = Figure(figsize=(2.4 * most, 2.6 * len(groups)), layout="constrained")
    grid = figure.subplots(len(groups), most, squeeze=False)
    for panels, (name, trials) in zip(grid, groups.items(), strict=True):
        slot = SlotConfig(gap=_gap(name))
        across = 0.5 * slot.width * slot.world_from_slot[:2, 1]
        for axes in panels:
            axes.set_axis_off()
        for axes, trial in zip(panels, sorted(trials, key=lambda t: t["success"])[:most], strict=False):
            for post in slot.boxes:
                ends = np.array(post.center[:2]) + np.outer([-1.0, 1.0], across)
                axes.plot(*ends.T, color="#57606a", linewidth=3, solid_capstyle="butt")
            axes.plot(*np.array(trial["goal"])[:, :2].T, color="#8c959f", linewidth=1.2)
            axes.plot(*np.array(trial["rope"])[:, :2].T, color=COLORS.get(_twin(name), OTHER), linewidth=2)
            axes.plot(*np.array(trial["way"])[:, :2].T, ":", color="#1b1f24", linewidth=1)
            axes.set_aspect("equal")
            axes.set_title(f"{name}\n{trial['seed']}: {trial['outcome'][:24]}", fontsize=6)
    return figure


def _twin(name: str) -> str:
    return next((t for t in COLORS if name.startswith(t)), name)


def _setting(name: str) -> str:
    return name.removeprefix(_twin(name)).strip("-")


def _gap(name: str) -> float:
    found = re.search(r"-gap([0-9.]+)-", name)
    return SlotConfig.gap if found is None else 1e-3 * float(found[1])

"""What the trials say: success with exact intervals, chamfer against time, seconds a replan, collisions; a report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hidden_scores import clopper_pearson
from matplotlib.figure import Figure

from pred_core.bag.deform import SOURCE_FILE
from pred_core.errors import InputError
from pred_core.plant.live.slot import SlotConfig
from pred_core.report.page import Page
from pred_core.types import Array

COLORS = {"pred": "#009E73", "spring-mass": "#D55E00"}
OTHER = "#0072B2"
GRID = 0.4  # [s] of the curves
HEADER = ("trials", "through", "95 % interval", "time to it [s]", "chamfer at the end [mm]", "rope on slot [s]",
          "hand on slot", "state error [mm]", "CPU s a replan", "plans refused")  # fmt: skip


def write_scores(work: Path) -> int:
    """Print the table; write scores.json and report.html. Raises: InputError without trials."""
    groups = read_trials(work)
    scores = {name: score(trials) for name, trials in groups.items()}
    (work / "scores.json").write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")
    rows = [(name, *row(s)) for name, s in scores.items()]
    print("| twin, eyes, gap, cable | " + " | ".join(HEADER) + " |")
    print("|" + "---|" * (len(HEADER) + 1))
    for line in rows:
        print("| " + " | ".join(line) + " |")
    page = Page("A cable led through a slot")
    page.table(("twin, eyes, gap, cable", *HEADER), rows)
    page.text(
        "Through: all rope within the posts lies in the gap and below their top by 1 cm, 2 cm or more on both sides, "
        "an odd number of crossings, the gripper below the top, at two looks in a row. The interval is Clopper and "
        "Pearson's. Time, contact and errors are means; time over the trials that succeeded.", note=True,
    )  # fmt: skip
    page.figure(curves(groups), "Chamfer distance (two-sided, unsquared) of the true rope to the goal: each trial, and "
                "the median of all, where a trial that ended keeps its last value.")  # fmt: skip
    page.figure(views(groups), "From above, the first trials of each: goal (grey), the rope at the end, the gripper's "
                "way (dotted).")  # fmt: skip
    page.write(work / "report.html")
    print(f"wrote {work / 'scores.json'} and {work / 'report.html'}")
    return 0


def read_trials(work: Path) -> dict[str, list[dict[str, Any]]]:
    """Trials by folder, in order of their seeds. Raises: InputError if there is none."""
    groups = {}
    for folder in sorted((work / "trials").glob("*")):
        paths = sorted(p for p in folder.glob("*.json") if p.name != SOURCE_FILE)
        if paths:
            groups[folder.name] = [json.loads(p.read_text(encoding="utf-8")) for p in paths]
    if not groups:
        raise InputError(f"{work}: no trials", next_step="Make some with the command 'run'")
    return groups


def score(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the trials of one twin in one setting; nan where nothing succeeded."""
    good = [t for t in trials if t["success"]]
    low, high = clopper_pearson(len(good), len(trials))
    replans = [r for t in trials for r in t["replans"]]
    return {
        "trials": len(trials),
        "successes": len(good),
        "interval": [low, high],
        "seconds_to_success": _mean([t["time"] for t in good]),
        "chamfer_end_mm": _mean([1e3 * t["chamfer"][-1][1] for t in trials]),
        "rope_on_slot_s": _mean([t["touch_seconds"]["rope on slot"] for t in trials]),
        "hand_on_slot": sum(t["touch_count"]["gripper on slot"] for t in trials),
        "state_error_mm": _mean([e for t in trials for e in t["state_error_mm"]]),
        "cpu_seconds_a_replan": float(np.median([r["cpu"] for r in replans])) if replans else float("nan"),
        "wall_seconds_a_replan": float(np.median([r["wall"] for r in replans])) if replans else float("nan"),
        "motions_a_replan": int(np.median([r["motions"] for r in replans])) if replans else 0,
        "refused": sum(len(t["refused"]) for t in trials),
        "cpu_seconds_a_trial": _mean([t["cpu_seconds"] for t in trials]),
        "failed": [{"seed": t["seed"], "outcome": t["outcome"]} for t in trials if not t["success"]],
    }


def row(s: dict[str, Any]) -> tuple[str, ...]:
    """A line of the table."""
    low, high = s["interval"]
    return (
        str(s["trials"]), str(s["successes"]), f"{low:.0%} to {high:.0%}", f"{s['seconds_to_success']:.1f}",
        f"{s['chamfer_end_mm']:.0f}", f"{s['rope_on_slot_s']:.2f}", str(s["hand_on_slot"]),
        f"{s['state_error_mm']:.1f}", f"{s['cpu_seconds_a_replan']:.2f}", str(s["refused"]),
    )  # fmt: skip


def curve(trials: Sequence[dict[str, Any]]) -> tuple[Array, Array]:
    """Times (T,) [s] and the median chamfer distance (T,) [mm]; a trial that ended keeps its last value."""
    longest = max(t["chamfer"][-1][0] for t in trials)
    times = np.arange(0.0, longest + 0.5 * GRID, GRID)
    values = [np.interp(times, *np.array(t["chamfer"]).T) for t in trials]
    return times, 1e3 * np.median(values, axis=0)


def curves(groups: dict[str, list[dict[str, Any]]]) -> Figure:
    """One panel for what differs beside the twin."""
    panels: dict[str, list[str]] = {}
    for name in groups:
        panels.setdefault(_setting(name), []).append(name)
    figure = Figure(figsize=(5.5 * len(panels), 3.6), layout="constrained")
    for axes, (title, names) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
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
    slot = SlotConfig()
    across = 0.5 * slot.width * slot.world_from_slot[:2, 1]
    grid = figure.subplots(len(groups), most, squeeze=False)
    for panels, (name, trials) in zip(grid, groups.items(), strict=True):
        for axes in panels:
            axes.set_axis_off()
        for axes, trial in zip(panels, trials[:most], strict=False):
            for post in slot.boxes:
                ends = np.array(post.center[:2]) + np.outer([-1.0, 1.0], across)
                axes.plot(*ends.T, color="#57606a", linewidth=3, solid_capstyle="butt")
            axes.plot(*np.array(trial["goal"])[:, :2].T, color="#8c959f", linewidth=1.2)
            axes.plot(*np.array(trial["rope"])[:, :2].T, color=COLORS.get(_twin(name), OTHER), linewidth=2)
            axes.plot(*np.array(trial["way"])[:, :2].T, ":", color="#1b1f24", linewidth=1)
            axes.set_aspect("equal")
            axes.set_title(f"{name}\n{trial['seed']}: {trial['outcome'][:24]}", fontsize=6)
    return figure


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _twin(name: str) -> str:
    return next((t for t in COLORS if name.startswith(t)), name)


def _setting(name: str) -> str:
    return name.removeprefix(_twin(name)).strip("-")

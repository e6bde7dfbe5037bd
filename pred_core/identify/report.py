"""The HTML report of an identification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pred_core.identify.run import Identified
from pred_core.report import Page
from pred_core.report.page import number

BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#8c959f"  # colour-blind safe (Okabe and Ito)

DEFINITIONS = {
    "error_mm": "mean absolute error per coordinate of free particles, open loop over whole episodes [mm]",
    "error_mm.fitted": "mean over the best 90 % of windows of all train recordings, after the last refit on them",
    "error_mm.held_out": "mean over the best 90 % of windows of recordings held out, before the last refit on all "
    "recordings: not of the parameters that are stored; null: nothing was held out",
    "error_mm.episodes": "every train episode, after the last refit",
}  # of the keys in `identify.json`


def write_report(path: Path, result: Identified, command: str) -> None:
    """Parameters with spread and sensitivity, restarts, and the error of every episode."""
    page = Page(f"Identification of {result.twin.meta.object.name}")
    page.code(command)
    check = ""
    if result.held_out_mm is not None:
        check = (
            f" {number(result.held_out_mm)} mm on recordings held out, also the best 90 %, by the parameters before "
            "the last refit: the values below were then refitted on all recordings, for which nothing is held out."
        )
    page.text(
        "Mean error per coordinate of free particles, open loop over whole episodes: "
        f"{number(result.fitted_mm)} mm on the best 90 % of the train episodes, which the parameters were fitted on."
        f"{check} Track noise {number(result.noise_mm)} mm. Seed {result.seed}, {result.seconds:.0f} s."
    )
    page.heading("Parameters")
    header = ("parameter", "value", "unit", "95 % interval", "spread over restarts", "loss at 10 % change", "")
    marks = ["warn" if flags(e) else "" for e in result.values.values()]
    page.table(header, [_row(n, e) for n, e in result.values.items()], marks)
    page.text(
        "Where a change of 10 % changes the loss by less than 0.1 %, these data do not show the parameter: any value "
        "near it predicts as well, and no interval is given; nor is one where the loss does not rise to both sides, as "
        "with few or chaotic recordings. Intervals are local: they come from how the loss of each "
        "recording changes over 10 % with the other parameters fixed, and say nothing of other optima, of parameters "
        "that trade against each other, or of what the model lacks.",
        note=True,
    )
    for note in result.twin.meta.notes:
        page.text(note, note=True)
    page.heading("Restarts of the global search")
    names = [k for k in result.restarts[0] if k not in ("seed", "loss_mm", "evaluations")]
    rows = []
    for r in result.restarts:
        rows.append([r["seed"], r["evaluations"], number(r["loss_mm"]), *(number(r[n]) for n in names)])
    page.table(("seed", "candidates", "loss [mm]", *names), rows)
    page.heading("Error of every train episode")
    page.figure(_episodes(result), "Mean error per coordinate of free particles over the whole episode, open loop.")
    if result.left_out:
        page.text(
            f"Left out of the last refinement as outliers (above twice the median): {', '.join(result.left_out)}. "
            "Look for swapped or slipping markers there."
        )
    page.write(path)


def flags(entry: dict[str, Any]) -> str:
    """What a reader must know of a parameter's value; empty if nothing."""
    said = []
    if entry["at_bound"]:
        said.append("at a bound")
    if not entry["identifiable"]:
        said.append("not identifiable from these data")
    return ", ".join(said)


def _row(name: str, entry: dict[str, Any]) -> tuple[str, ...]:
    return (
        name,
        number(float(entry["value"]), 4),
        entry["unit"] or "–",
        _pair(entry.get("interval")),
        _pair(entry.get("spread")),
        f"{100.0 * entry['sensitivity']:+.2f} %",
        flags(entry),
    )


def _pair(values: list[float] | None) -> str:
    return "–" if values is None else f"{number(values[0])} to {number(values[1])}"


def _episodes(result: Identified) -> Figure:
    names = list(result.windows)
    values = np.array([result.windows[n] for n in names])
    figure = Figure(figsize=(10, 3), layout="constrained")
    axes = figure.subplots()
    colors = [ORANGE if n in result.left_out else BLUE for n in names]
    axes.bar(np.arange(len(names)), values, color=colors, width=0.8)
    axes.axhline(float(np.median(values)), color=GREY, linewidth=1)
    axes.text(len(names) - 0.4, float(np.median(values)), " median", va="center", color=GREY, fontsize=8)
    axes.set_xticks(np.arange(len(names)), names, rotation=90, fontsize=6)
    axes.set_ylabel("error [mm]")
    axes.spines[["top", "right"]].set_visible(False)
    return figure

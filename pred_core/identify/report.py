"""The HTML report of an identification."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pred_core.identify.run import Identified
from pred_core.report import Page
from pred_core.report.page import number

BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#8c959f"  # colour-blind safe (Okabe and Ito)


def write_report(path: Path, result: Identified, command: str) -> None:
    """Parameters with spread and sensitivity, restarts, and the error of every episode."""
    page = Page(f"Identification of {result.twin.meta.object.name}")
    page.code(command)
    check = "" if result.held_out_mm is None else f", {number(result.held_out_mm)} mm on recordings that were not fitted"
    page.text(
        f"Mean error per coordinate of free particles, open loop over whole episodes: {number(result.fitted_mm)} mm on "
        f"the best 90 % of the train episodes{check}. Track noise {number(result.noise_mm)} mm. Seed {result.seed}, "
        f"{result.seconds:.0f} s."
    )
    page.heading("Parameters")
    rows, marks = [], []
    for name, e in result.values.items():
        spread, interval = e.get("spread"), e.get("interval")
        rows.append((
            name, number(float(e["value"]), 4), str(e["unit"]) or "–", _pair(interval), _pair(spread),  # type: ignore[arg-type]
            f"{100.0 * float(e['sensitivity']):+.2f} %", "at a bound" if e["at_bound"] else "",  # type: ignore[arg-type]
        ))  # fmt: skip
        marks.append("warn" if e["at_bound"] else "")
    page.table(("parameter", "value", "unit", "95 % interval", "spread over restarts", "loss at 10 % change", ""), rows, marks)
    page.text(
        "A loss that hardly changes when a parameter moves by 10 % means that these data do not show it. The interval "
        "is local and takes episodes as independent; adjacent windows of one recording are not.", note=True,
    )
    for note in result.twin.meta.notes:
        page.text(note, note=True)
    page.heading("Restarts of the global search")
    names = [k for k in result.restarts[0] if k not in ("seed", "loss_mm")]
    table = [[r["seed"], number(float(str(r["loss_mm"]))), *(number(float(str(r[n]))) for n in names)] for r in result.restarts]
    page.table(("seed", "loss [mm]", *names), table)
    page.heading("Error of every train episode")
    page.figure(_episodes(result), "Mean error per coordinate of free particles over the whole episode, open loop.")
    if result.left_out:
        page.text(f"Left out of the last refinement as outliers (above twice the median): {', '.join(result.left_out)}.")
    page.write(path)


def _pair(values: object) -> str:
    if not isinstance(values, list):
        return "–"
    return f"{number(float(values[0]))} to {number(float(values[1]))}"


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

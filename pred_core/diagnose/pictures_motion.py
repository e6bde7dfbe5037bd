"""The motion that would tell two causes apart, in the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pred_core.diagnose.motion_file import for_the_arm
from pred_core.diagnose.report_parts import words
from pred_core.diagnose.result import Diagnosis
from pred_core.evaluate.style import GREY, INK, tidy
from pred_core.report import Page, number
from pred_core.types import Array

RIVALS = ("#0072B2", "#D55E00")
SHOWN = 10  # motions in the table
VIEWS = (("side", 0, 2), ("front", 1, 2), ("above", 0, 1))


def add_next_motion(page: Page, d: Diagnosis) -> None:
    """What to record next, why, and how it looks; or why nothing is proposed."""
    page.heading("The motion that would tell it apart")
    motion = d.next_motion
    if motion is None:
        page.text("No motion is proposed: no other cause comes near enough, or the grippers showed no room to move in.")
        return
    page.text(f"Record this next: {motion['name']}.")
    page.text(f"{motion['why']}.", note=True)
    line = d.base_twin.body.kind == "line"
    page.figure(_picture(motion, line), _caption(motion))
    best = motion["tried"][0]["distance_mm"] or 1.0
    rows = [
        (t["name"], f"{t['distance_mm']:.2f}", number(t["distance_sigma"]), f"{100 * t['distance_mm'] / best:.0f} %")
        for t in motion["tried"][:SHOWN]
    ]
    page.table(("motion", "apart [mm]", "standard deviations", "of the best"), rows, ["strong"])
    more = len(motion["tried"]) - SHOWN
    begin, bound = motion["start"], motion["limits"]
    page.text(
        (f"{more} more motions tell less. " if more > 0 else "")
        + f"It begins at the pose of {begin['episode']}, frame {begin['frame']}, after the object has rested there for "
        f"{begin['rest_first']:g} s, and stays within what the recordings showed: {bound['speed']:.2f} m/s, "
        f"{bound['acceleration']:.1f} m/s^2, {bound['turn_speed']:.2f} rad/s and their box. Ranked by the distance in "
        "standard deviations of track noise and of what small changes of start and base do. As a plan: "
        f"next_motion.yaml. {_for_the_arm(motion)}",
        note=True,
    )


def _for_the_arm(motion: Mapping[str, Any]) -> str:
    needs = for_the_arm(motion)
    if not needs:
        return "The arm node's usual limits allow it."
    return f"The arm node's usual limits do not allow it: it needs {needs}, where that is safe."


def _caption(motion: Mapping[str, Any]) -> str:
    a, b = _labels(motion)
    return (
        f"Left: the grippers' way (dot: start) and the object as {a} and {b} predict it "
        f"{motion['widest']['time']:.2f} s after the start, where they are farthest apart. "
        "Right: the grippers over time."
    )


def _labels(motion: Mapping[str, Any]) -> tuple[str, str]:
    first, second = motion["rivals"]
    if first["id"] == second["id"]:
        return f"less {words(first['id'])}", f"more {words(second['id'])}"
    return words(first["id"]), words(second["id"])


def _picture(motion: Mapping[str, Any], line: bool) -> Figure:
    times, way = _way(motion["trajectory"])
    shapes = [np.array(s) for s in motion["widest"]["shapes"]]
    figure = Figure(figsize=(13, 3.7), layout="constrained")
    grid = figure.subplots(1, 4)
    for axes, (view, a, b) in zip(grid[:3], VIEWS, strict=True):
        for shape, color, label in zip(shapes, RIVALS, _labels(motion), strict=True):
            axes.plot(shape[:, a], shape[:, b], "o-" if line else ".", color=color, markersize=2.5, label=label)
        for g in range(way.shape[1]):
            axes.plot(way[:, g, a], way[:, g, b], color=INK, linewidth=1.2)
            axes.plot(*way[0, g, [a, b]], "o", color=INK, markersize=5)
        axes.set_title(view, loc="left", fontsize=11, fontweight="bold", color=INK)
        axes.set_aspect("equal", adjustable="datalim")
        tidy(axes, f"{'xyz'[a]} [m]", f"{'xyz'[b]} [m]")
    for k, dash in enumerate(("-", "--", ":")):
        for g in range(way.shape[1]):
            axes = grid[3]
            axes.plot(times, 1e3 * (way[:, g, k] - way[0, g, k]), dash, color=INK, linewidth=1.5,
                      label="xyz"[k] if g == 0 else None)  # fmt: skip
    angle = _angle(motion["trajectory"])
    if angle.max() > 0.02:
        turned = grid[3].twinx()
        turned.plot(times, angle, color=GREY, linewidth=1.2, label="turn")
        turned.set_ylabel("turned [rad]", color=GREY)
        turned.spines["top"].set_visible(False)
    tidy(grid[3], "time [s]", "shift of the gripper [mm]")
    grid[3].legend(frameon=False, fontsize=9)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False, fontsize=10)
    return figure


def _way(trajectory: Mapping[str, Any]) -> tuple[Array, Array]:
    """Times (T,) [s] and places (T, G, 3) [m]."""
    points = trajectory["points"]
    places = [[t["translation"] for t in p["transforms"]] for p in points]
    return np.array([p["time_from_start"] for p in points]), np.array(places)


def _angle(trajectory: Mapping[str, Any]) -> Array:
    """(T,) [rad] by which gripper 0 is turned from its first pose."""
    q = np.array([p["transforms"][0]["rotation"] for p in trajectory["points"]])
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(q @ q[0]), 0.0, 1.0)))

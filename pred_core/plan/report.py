"""`plan.json` and the HTML report of an offline plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from pred_core.config import to_mapping
from pred_core.frames import quaternion_to_matrix
from pred_core.plan.config import PlannerConfig
from pred_core.plan.offline import Run
from pred_core.report.animation import Track, animation
from pred_core.report.page import Page, number
from pred_core.types import Array, Box, Scene

INK, GOAL, NOW, WAY, POST = "#1b1f24", "#009E73", "#0072B2", "#D55E00", "#c9ced4"
VIEWS = (("from above", 0, 1), ("from the front", 0, 2), ("from the side", 1, 2))
AXES = "xyz"


def summary(run: Run, config: PlannerConfig, extra: dict[str, Any]) -> dict[str, Any]:
    """What plan.json holds. `extra`: twin, goal, seed, command."""
    last = run.plans[-1]
    seconds = [p.seconds for p in run.plans]
    return {
        **extra,
        "distance_m": {
            "start": float(run.distance[0]),
            "end": float(run.distance[-1]),
            "least": float(run.distance.min()),
            "each_frame": np.round(run.distance, 5).tolist(),
        },
        "trajectory": {
            "frame": "world",
            "period": run.period,
            "time": np.round(run.period * np.arange(len(run.gripper)), 6).tolist(),
            "position": np.round(run.gripper, 6).tolist(),
            "rotation_wxyz": np.round(run.rotation, 7).tolist(),
        },
        "replans": len(run.plans),
        "cost": {"last": last.cost, "parts": last.parts, "standing_still": last.still},
        "seconds_per_replan": {"median": float(np.median(seconds)), "most": float(np.max(seconds))},
        "motions": int(sum(p.motions for p in run.plans)),
        "frames_simulated_per_second": float(sum(p.motions * p.steps for p in run.plans) / max(sum(seconds), 1e-9)),
        "settings": to_mapping(config),
    }


def write_report(
    folder: Path, run: Run, goal: Array, scene: Scene, config: PlannerConfig, extra: dict[str, Any], line: bool
) -> None:
    """Write plan.json and plan.html. goal (Q, 3) [m]; line: consecutive particles are joined."""
    folder.mkdir(parents=True, exist_ok=True)
    result = summary(run, config, extra)
    (folder / "plan.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    page = Page(f"Plan: {extra.get('object', 'object')} to a goal")
    first, end = 1e3 * run.distance[0], 1e3 * run.distance[-1]
    page.text(
        f"Two-sided chamfer distance to the goal: {first:.1f} mm at the start, {end:.1f} mm at the end, after "
        f"{len(run.plans)} plans and {run.period * (len(run.distance) - 1):.1f} s of motion in the twin's simulation."
    )
    page.code(str(extra.get("command", "")))
    page.figure(_views(run, goal, scene, line), "Start (grey), end (blue), goal (green), the grippers' way (orange).")
    page.html(animation([Track("planned", run.position, NOW), Track("goal", _still(run, goal), GOAL)], run.period,
                        line=line, title="the plan carried out by the twin"))  # fmt: skip
    page.heading("How it was found")
    page.figure(
        _curves(run),
        "Left: distance to the goal while the plans are carried out. Right: the best cost of each plan against the "
        "time it had; a plan can only get better with time.",
    )
    last = run.plans[-1]
    rows = [(name, number(value)) for name, value in last.parts.items()]
    page.table(("cost of the last plan", "value"), [*rows, ("sum", number(last.cost)),
               ("standing still", number(last.still))], marks=[""] * len(rows) + ["strong", ""])  # fmt: skip
    spent = result["seconds_per_replan"]
    page.text(
        f"{spent['median']:.2f} s a plan (median), {result['motions']} motions tried, "
        f"{result['frames_simulated_per_second']:.0f} frames simulated a second.", note=True,
    )  # fmt: skip
    page.write(folder / "plan.html")


def _views(run: Run, goal: Array, scene: Scene, line: bool) -> Figure:
    figure = Figure(figsize=(11, 4), layout="constrained")
    for axes, (title, a, b) in zip(figure.subplots(1, 3), VIEWS, strict=True):
        for box in (f for f in scene.fixtures if isinstance(f, Box)):
            axes.add_patch(Polygon(_outline(box, a, b), closed=True, color=POST))
        if b == 2 and scene.ground is not None:
            axes.axhline(scene.ground, color=POST)
        style = "-" if line else "."
        axes.plot(goal[:, a], goal[:, b], ".", color=GOAL, markersize=5, alpha=0.7)
        axes.plot(run.position[0, :, a], run.position[0, :, b], style, color="#8c959f", linewidth=1.5)
        axes.plot(run.position[-1, :, a], run.position[-1, :, b], style, color=NOW, linewidth=2.2)
        for g in range(run.gripper.shape[1]):
            axes.plot(run.gripper[:, g, a], run.gripper[:, g, b], "-", color=WAY, linewidth=1.2)
            axes.plot(*run.gripper[-1, g, [a, b]], "o", color=WAY, markersize=4)
        _tidy(axes, f"{AXES[a]} [m]", f"{AXES[b]} [m]", title)
        axes.set_aspect("equal", adjustable="datalim")
    return figure


def _curves(run: Run) -> Figure:
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    time = run.period * np.arange(len(run.distance))
    left.plot(time, 1e3 * run.distance, color=NOW)
    begin = run.plans[0].start
    for plan in run.plans:
        left.axvline((plan.start - begin) * 1e-9, color=POST, linewidth=0.8, zorder=0)
    left.set_ylim(bottom=0)
    _tidy(left, "time [s]", "chamfer distance [mm]", "on the way")
    for k, plan in enumerate(run.plans):
        seconds, cost = np.array(plan.history).T
        right.plot(seconds, cost, color=NOW, alpha=0.25 + 0.75 * (k + 1) / len(run.plans), linewidth=1.2)
    _tidy(right, "planning [s]", "best cost", "each plan")
    return figure


def _outline(box: Box, a: int, b: int) -> Array:
    """Convex outline (M, 2) of a box seen along the third axis."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    turn = quaternion_to_matrix(torch.tensor(box.rotation, dtype=torch.float64)).numpy()
    corners = (np.array(box.center) + (signs * np.array(box.half_size)) @ turn.T)[:, [a, b]]
    return np.asarray(corners[ConvexHull(corners).vertices])


def _still(run: Run, goal: Array) -> Array:
    """The goal in every frame, with as many points as the object has (NaN where it has fewer)."""
    count = run.position.shape[1]
    shown = np.full((count, 3), np.nan)
    chosen = goal[np.linspace(0, len(goal) - 1, min(count, len(goal))).round().astype(int)]
    shown[: len(chosen)] = chosen
    return np.broadcast_to(shown, run.position.shape).copy()


def _tidy(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.set_title(title, fontsize=10, color=INK)
    axes.grid(True, color="#e4e7eb", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)

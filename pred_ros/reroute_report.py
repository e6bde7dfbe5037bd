"""The report of a run: reroute.json, report.html with the video in it, and the video as a file of its own."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pred_core.errors import ConfigError
from pred_core.report.animation import Track, animation
from pred_core.report.page import Page, number
from pred_ros.reroute_record import NS, Record, Said
from pred_ros.reroute_verdict import FaultVerdict, Verdict, errors, goal_distances
from pred_ros.reroute_video import write_video

JSON, PAGE, VIDEO = "reroute.json", "report.html", "video.webm"
LEVELS = ("ok", "warning", "error")
BLUE, ORANGE, GREY, RED = "#0b5cad", "#d9480f", "#8c959f", "#c1121f"
ERROR_SHOWN = 60.0  # [mm] most of the axis of errors
_NUMBERS = re.compile(r"\d+(\.\d+)?")


def write_report(record: Record, verdict: Verdict, extra: dict[str, Any], folder: Path) -> None:
    """Write the three files. `extra`: what else the JSON says. Raises: ConfigError if the folder cannot be written."""
    pictures = write_video(record, folder / VIDEO)
    values = {**extra, **verdict.as_json(), "said": [_said(record, s) for s in record.said]}
    values["events"] = [{"time": record.seconds(s), "text": text} for s, text in record.events]
    try:
        (folder / JSON).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
        _page(record, verdict, extra, folder / VIDEO if pictures else None).write(folder / PAGE)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written", got=error) from error


def _said(record: Record, said: Said) -> dict[str, Any]:
    level = LEVELS[min(said.level, 2)]
    return {"time": record.seconds(said.stamp), "node": said.node, "level": level, "message": said.message}


def _page(record: Record, verdict: Verdict, extra: dict[str, Any], video: Path | None) -> Page:
    page = Page("The rope and the slot")
    page.lead(lead(verdict))
    page.code(str(extra.get("command", "")))
    if verdict.fault is not None:
        page.heading("The fault")
        page.text(outcome(verdict))
        page.table(("", ""), _fault_rows(verdict.fault))
    if video is not None:
        page.html(_video(video))
    page.table(("", ""), _rows(verdict))
    page.figure(
        _curves(record),
        "Top: distance of the true rope to the goal; shaded: through the slot. Middle: how far tracks and state are "
        "from the truth. Bottom: time per replan. Red lines: what was broken.",
    )
    truth = [(s, p) for s, p in record.truth if s >= record.begin]
    if len(truth) > 1:
        page.html(_moving(record, truth))
    page.heading("What the nodes said")
    page.text("Every change of a node's diagnostics; lines that differ only in numbers are counted.", note=True)
    rows, marks = timeline(record)
    page.table(("time [s]", "node", "level", "message", "times"), rows, marks)
    return page


def lead(verdict: Verdict) -> str:
    """The sentence the page opens with."""
    state = f"{verdict.seconds:.1f} s of the cell's time ({verdict.factor:.2f} x real time), {verdict.replans} plans"
    end = f"{1e3 * verdict.chamfer['end']:.0f} mm from the goal" if verdict.chamfer else "no truth was seen"
    what = "The rope went through the slot" if verdict.success else "The rope is not in the slot"
    return f"{what}: {state}, at the end {end}."


def outcome(verdict: Verdict) -> str:
    """One line about a fault."""
    fault = verdict.fault
    assert fault is not None
    arm = "went on" if fault.stopped_after is None else f"came to rest after {fault.stopped_after:.1f} s"
    after = "the rope went through the slot" if verdict.success else "the rope did not go through the slot"
    said = f"said after {fault.named_after:.1f} s: {fault.named}" if fault.named else "no node named it"
    hits = "" if fault.safe else f"; NOT SAFE: {fault.speed:.2f} m/s, {fault.collisions} collisions"
    return f"The arm {arm}; {fault.plans_after} plans came later; {after}{hits}; {said}"


def timeline(record: Record) -> tuple[list[tuple[object, ...]], list[str]]:
    """Rows of what was said, one for each run of lines of a node that differ only in numbers; and marks."""
    rows: list[list[Any]] = []
    newest: dict[str, int] = {}  # node -> its last row
    for said in [*record.said, *(Said(s, "run", 1, text) for s, text in record.events)]:
        shape = _NUMBERS.sub("#", said.message)
        last = newest.get(said.node)
        if last is not None and rows[last][5] == shape and rows[last][2] == said.level:
            rows[last][4] += 1
            continue
        newest[said.node] = len(rows)
        rows.append([record.seconds(said.stamp), said.node, said.level, said.message, 1, shape])
    rows.sort(key=lambda r: r[0])
    told: list[tuple[object, ...]] = [(f"{r[0]:.1f}", r[1], LEVELS[min(r[2], 2)], r[3], r[4]) for r in rows]
    return told, ["warn" if r[2] else "" for r in rows]


def _rows(verdict: Verdict) -> list[tuple[object, object]]:
    rows: list[tuple[object, object]] = [
        ("through the slot, judged on the truth", "yes" if verdict.success else "no"),
        ("cell's time [s]", number(verdict.seconds)),
        ("real-time factor", number(verdict.factor)),
    ]
    for name, values in (("tracker", verdict.tracker_error), ("state", verdict.state_error)):
        shown = " / ".join(number(1e3 * values[k]) for k in ("mean", "median", "max")) if values else "–"
        rows.append((f"{name} against the truth: mean / median / max [mm]", shown))
    rows.append(("chamfer distance to the goal: begin / least / end [mm]",
                 " / ".join(number(1e3 * verdict.chamfer[k]) for k in ("begin", "least", "end"))
                 if verdict.chamfer else "–"))  # fmt: skip
    rows.append(("plans sent", verdict.replans))
    for name, what in (("median", "computing per replan, median [s]"), ("p90", "computing per replan, 90 % below [s]"),
                       ("motions", "motions tried per replan, median")):  # fmt: skip
        rows.append((what, number(verdict.replan.get(name))))
    return rows + [(f"collisions, {pair}", count) for pair, count in verdict.collisions.items()]


def _fault_rows(fault: FaultVerdict) -> list[tuple[object, object]]:
    return [
        ("begin [s]", number(fault.begin)),
        ("named by", fault.named or "nobody"),
        ("named after [s]", number(fault.named_after)),
        ("arm first at rest after [s]", number(fault.stopped_after)),
        ("largest speed afterwards [m/s]", number(fault.speed)),
        ("collisions of the gripper afterwards", fault.collisions),
        ("plans more than 1 s after it", fault.plans_after),
    ]


def _curves(record: Record) -> Figure:
    figure = Figure(figsize=(9.5, 6.6), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    times, distance = goal_distances(record)
    top.plot(times, 1e3 * distance, color=BLUE)
    through = np.array([p.success for s, p in record.judged if s >= record.begin], bool)
    when = np.array([record.seconds(s) for s, _ in record.judged if s >= record.begin])
    if len(when):
        high = 1e3 * float(distance.max()) if len(distance) else 1.0
        top.fill_between(when, 0.0, high, where=through.tolist(), color="#2da44e", alpha=0.15, step="post")
    top.set(ylabel="to the goal [mm]", ylim=(0, None))
    for name, seen, colour in (("tracks", record.tracked, ORANGE), ("state", record.states, BLUE)):
        at, error = errors(record, seen)
        middle.plot(at, 1e3 * error, color=colour, label=name, linewidth=1.2)
    middle.set(ylabel="from the truth [mm]")
    middle.set_ylim(0, min(middle.get_ylim()[1], ERROR_SHOWN))
    middle.legend(frameon=False, ncols=2)
    sent = [(record.seconds(p.stamp), p.wall) for p in record.plans]
    if len(sent) > 1:
        table = np.array(sent)
        bottom.plot(table[1:, 0], np.diff(table[:, 1]), ".", color=GREY, label="between two plans")
    if record.planning:
        bottom.plot([record.seconds(s) for s, _, _ in record.planning], [t for _, t, _ in record.planning],
                    "-", color=BLUE, label="computing")  # fmt: skip
    bottom.set(ylabel="replan [s on the wall]", xlabel="cell's time since the arm was enabled [s]", ylim=(0, None))
    if bottom.lines:  # without any plan there is nothing to explain
        bottom.legend(frameon=False, ncols=2)
    for axes in (top, middle, bottom):
        _tidy(axes, [record.seconds(s) for s, _ in record.events])
    return figure


def _tidy(axes: Axes, events: Sequence[float]) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    for when in events:
        axes.axvline(when, color=RED, linewidth=0.9)


def _moving(record: Record, truth: list[tuple[int, Any]]) -> str:
    """The true rope beside what was tracked at the same stamps."""
    rope = np.stack([p for _, p in truth])
    tracked = {s: p for s, p in record.tracked}
    along = np.linspace(0.0, 1.0, rope.shape[1])
    shown = np.full_like(rope, np.nan)
    for k, (stamp, _) in enumerate(truth):
        points = tracked.get(stamp)
        if points is not None:
            at = np.linspace(0.0, 1.0, len(points))
            shown[k] = np.stack([np.interp(along, at, points[:, a]) for a in range(3)], axis=1)
    period = float(np.median(np.diff([s for s, _ in truth]))) / NS
    tracks = [Track("truth", rope, "#1b1f24"), Track("tracked", shown, ORANGE)]
    return animation(tracks, period, line=True, title="The true rope and the tracked one.")


def _video(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure><video controls loop muted style="max-width:100%" src="data:video/webm;base64,{data}"></video>'
        f"<figcaption>Camera view of the run; the file is {path.name}.</figcaption></figure>"
    )

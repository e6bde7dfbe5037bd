"""What the trials say: success with exact intervals and in pairs, chamfer against time, computing, collisions."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hidden_scores import clopper_pearson
from reroute_figures import COLORS, curves, settings_of, shares, views

from pred_core.bag.deform import SOURCE_FILE
from pred_core.errors import InputError
from pred_core.report.page import Page

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
    pairs = [line for setting in settings_of(groups) if (line := paired_line(groups, setting))]
    print("\n".join(pairs))
    page = Page("A cable led through a slot")
    page.table(("twin, eyes, gap, cable", *HEADER), rows)
    page.text(
        "Through: all rope within the posts lies in the gap and below their top by 1 cm, 2 cm or more on both sides, "
        "an odd number of crossings, the gripper below the top, at two looks in a row. The interval is Clopper and "
        "Pearson's. Time, contact and errors are means; time over the trials that succeeded.", note=True,
    )  # fmt: skip
    for line in pairs:
        page.text(line)
    page.figure(shares(groups), "Share of the trials that are through, against time.")
    page.figure(curves(groups), "Chamfer distance (two-sided, unsquared) of the true rope to the goal: each trial, and "
                "the median of all, where a trial that ended keeps its last value.")  # fmt: skip
    page.figure(views(groups), "From above, some trials of each, those that failed first: goal (grey), the rope at the "
                "end, the gripper's way (dotted).")  # fmt: skip
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


def paired_line(groups: dict[str, list[dict[str, Any]]], setting: str) -> str:
    """The twins on the same starts, and the exact two-sided sign test; empty where only one was tried."""
    good = [{t["seed"]: t["success"] for t in groups.get(f"{twin}-{setting}", [])} for twin in COLORS]
    both = sorted(good[0].keys() & good[1].keys())
    if not both:
        return ""
    only = [sum(good[k][s] and not good[1 - k][s] for s in both) for k in (0, 1)]
    p = sign_test(*only)
    a, b = COLORS
    return f"{setting}, {len(both)} same starts: only {a} {only[0]}, only {b} {only[1]} (sign test p = {p:.2g})"


def sign_test(a: int, b: int) -> float:
    """Two-sided p of a against b among a + b differing pairs; 1 where there is none."""
    tail = sum(math.comb(a + b, k) for k in range(min(a, b) + 1)) / 2.0 ** (a + b)
    return min(1.0, 2.0 * tail)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")

"""The paper's four rope tasks (IV-F) in lock-step: lift, lower, rotate about the far end, bend; chamfer against time.

    python benchmarks/rope_tasks.py --work out/trials [--tasks lift bend] [--trials 10] [--first 5000] [--once]

Both twins of `reroute.py twin` (spring-mass, pred), the true state, the same starts, goals and budgets. The goal is
where the rope lies after a scripted motion from the same start. With --once the rope is looked at once: one plan of
1,280 motions is carried out to its end. Finished trials are kept; at the end it prints, for each task and twin, the
chamfer distance after 2 s and at the end, and writes tasks.json and tasks.html.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from argument_types import count
from reroute import TWINS, about
from reroute_cell import DrivenCell, go
from reroute_eyes import TrueEyes
from reroute_figures import COLORS, curve, curves
from reroute_scores import sign_test
from reroute_trial import Trial, TrialConfig, check_twin, open_cell, write_whole

from pred_core.bag.deform import SOURCE_FILE, claim_folder
from pred_core.cli.main import BAD_INPUT
from pred_core.errors import PredError
from pred_core.plan.config import PlannerConfig
from pred_core.plan.planner import Planner
from pred_core.plan.task import load_settings, make_planner
from pred_core.plant.live.cell import Truth
from pred_core.plant.live.mover import Segment, ToolPose
from pred_core.plant.live.station import Station
from pred_core.report.page import Page
from pred_core.twin import Twin
from pred_core.types import Array

TASKS = ("lift", "lower", "rotate", "bend")
SETTINGS = Path(__file__).parents[1] / "config" / "plan" / "rope.yaml"
SETTINGS_ONCE = SETTINGS.with_name("rope_once.yaml")
HIGH, LOW = 0.18, 0.03  # [m] the hand is lifted by, and lowered to
TURN = 0.6  # [rad] about the far end
NEARER, ASIDE = 0.45, 0.08  # share of the way to the far end, and [m] across it, that bend the rope
MOVE = 2.5  # [s] of a scripted motion
LIMIT = 6.0  # [s] of a trial
SOON = 2.0  # [s]
ONCE, REST = "-once", 3.0  # what is appended to a task's name; [s] from the only look, past the plan, to the end


def hand_of(task: str, truth: Truth, settings: PlannerConfig) -> Array:
    """(3,) [m] world: where the scripted hand goes from a state, inside the planner's workspace."""
    hand, end = truth.gripper.position, truth.rope[-1]
    to_end = np.array([end[0] - hand[0], end[1] - hand[1], 0.0])
    across = np.array([-to_end[1], to_end[0], 0.0]) / np.linalg.norm(to_end)
    m = settings.motion
    low, high = np.array([m.x_low, m.y_low, m.z_low]), np.array([m.x_high, m.y_high, m.z_high])
    if task == "lift":
        wanted = [hand + [0.0, 0.0, HIGH]]
    elif task == "lower":
        wanted = [np.array([hand[0], hand[1], LOW])]
    elif task == "rotate":
        c, s = np.cos(TURN), np.sin(TURN)
        wanted = [end + np.array([[c, -k * s, 0.0], [k * s, c, 0.0], [0.0, 0.0, 1.0]]) @ (hand - end) for k in (1, -1)]
    else:
        wanted = [hand + NEARER * to_end + k * ASIDE * across for k in (1, -1)]
    # Of two sides the one that leaves the workspace less.
    best = min(wanted, key=lambda p: float(np.abs(p - np.clip(p, low, high)).max()))
    return np.clip(best, low, high)


def way(task: str, truth: Truth, reference: ToolPose, settings: PlannerConfig) -> Segment:
    """The scripted motion."""
    return Segment(reference, ToolPose(hand_of(task, truth, settings), reference.rotation), MOVE)


def run_task(twin: Twin, settings: PlannerConfig, config: TrialConfig, task: str, seed: int) -> dict[str, Any]:
    """One trial, ready for JSON."""
    check_twin(twin)
    with open_cell(config, twin) as cell:
        shown = Station(cell, pictures=False)
        truth = shown.reset(seed).truth
        first = way("lift", truth, cell.reference, settings) if task == "lower" else None
        truth = truth if first is None else go(shown, first).truth
        goal = go(shown, way(task, truth, cell.reference, settings)).truth.rope
        driven = DrivenCell(cell, pictures=False)

        def make(points: Array, clock: Callable[[], float]) -> Planner:
            return make_planner(twin, points, settings, seed, clock=clock)

        trial = Trial(driven, TrueEyes(twin), make, config, goal, slot=False)
        outcome = trial.run(driven.begin(seed, first))
        return {"seed": seed, "outcome": outcome, "chamfer": trial.chamfer, "replans": trial.replans,
                "refused": trial.refused, "way": trial.way, "goal": np.round(goal, 5).tolist()}  # fmt: skip


def _run(twin: Path, settings: str, config: TrialConfig, task: str, seed: int, path: Path) -> str:
    torch.set_num_threads(1)
    try:
        result = run_task(Twin.load(twin), load_settings(settings), config, task, seed)
    except PredError as error:
        return f"{path.parent.name} {seed}: failed: {error}"
    write_whole(path, result)
    begin, end = (1e3 * result["chamfer"][k][1] for k in (0, -1))
    return f"{path.parent.name} {seed}: {begin:.0f} to {end:.0f} mm, {result['outcome']}"


def write_tasks(work: Path) -> None:
    """The table, tasks.json and tasks.html of what is there."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for folder in sorted((work / "tasks").glob("*")):
        paths = sorted(p for p in folder.glob("*.json") if p.name != SOURCE_FILE)
        if paths:
            groups[folder.name] = [json.loads(p.read_text(encoding="utf-8")) for p in paths]
    rows, figures = [], {}
    for name, trials in groups.items():
        times, _ = curve(trials)
        looks = [] if name.endswith(ONCE) else trials  # nothing is measured in between there
        soon = [1e3 * float(np.interp(SOON, *np.array(t["chamfer"]).T)) for t in looks]
        end = [1e3 * t["chamfer"][-1][1] for t in trials]
        begin = [1e3 * t["chamfer"][0][1] for t in trials]
        figures[name] = {"trials": len(trials), "begin_mm": begin, "soon_mm": soon, "end_mm": end}
        means = (f"{np.mean(v):.1f} +- {np.std(v):.1f}" if v else "–" for v in (begin, soon, end))
        rows.append((name, str(len(trials)), *means))
        print(" | ".join(rows[-1]), f"| to {times[-1]:.1f} s")
    if not groups:
        return
    named = [f"{task}{kind}" for kind in ("", ONCE) for task in TASKS]
    print("\n".join(line for task in named if (line := paired_line(task, groups))))
    (work / "tasks.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    page = Page("Four rope tasks")
    page.table(("twin, task", "trials", "begin [mm]", f"after {SOON:g} s [mm]", "end [mm]"), rows)
    told = "Chamfer distance to the goal: each trial, and the median. Tasks looked at once: measured at both ends."
    page.figure(curves(groups), told)
    page.write(work / "tasks.html")


def paired_line(task: str, groups: dict[str, list[dict[str, Any]]]) -> str:
    """In how many of the same starts either twin ends nearer to the goal, and the sign test; empty without both."""
    ends = [{t["seed"]: t["chamfer"][-1][1] for t in groups.get(f"{twin}-{task}", [])} for twin in COLORS]
    both = sorted(ends[0].keys() & ends[1].keys())
    if not both:
        return ""
    nearer = [sum(ends[k][s] < ends[1 - k][s] for s in both) for k in (0, 1)]
    a, b = COLORS
    p = sign_test(*nearer)
    return f"{task}: {a} ends nearer in {nearer[0]}, {b} in {nearer[1]} of {len(both)} (sign test p = {p:.2g})"


def main() -> int:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="with the twins of reroute.py")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--trials", type=count(1), default=10)
    parser.add_argument("--first", type=count(0), default=5000, help="first seed")
    parser.add_argument("--jobs", type=count(1, 256), default=1)
    parser.add_argument("--once", action="store_true", help="one plan a trial, carried out without another look")
    args = parser.parse_args()
    config = TrialConfig(limit=REST, replan=REST) if args.once else TrialConfig(limit=LIMIT)
    settings, kind = (str(SETTINGS_ONCE), ONCE) if args.once else (str(SETTINGS), "")
    jobs = []
    try:
        for seed in range(args.first, args.first + args.trials):
            for task in args.tasks:
                for name in TWINS:
                    folder = args.work / "tasks" / f"{name}-{task}{kind}"
                    claim_folder(folder, {**about(args.work / name, settings, config), "task": task})
                    path = folder / f"{seed}.json"
                    if not path.exists():
                        jobs.append((args.work / name, settings, config, task, seed, path))
    except PredError as error:
        print(f"rope_tasks: {error}", file=sys.stderr)
        return BAD_INPUT
    lines = []
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for job in as_completed([pool.submit(_run, *one) for one in jobs]):
            lines.append(job.result())
            print(lines[-1], flush=True)
    write_tasks(args.work)
    return 1 if any("failed" in line for line in lines) else 0


if __name__ == "__main__":
    sys.exit(main())

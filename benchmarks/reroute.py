"""Leading a cable through a slot in lock-step: twins, trials, scores.

    python benchmarks/reroute.py twin --work out/trials
        the recipe: random motions in the cell, recorded through cameras and tracker; two twins of the same data with
        the same search: `spring-mass` (the paper's five parameters) and `pred` (bending by angle and its damping, and
        the residual where it helps on held-out recordings). No access to the truth. Goes on where it stopped
    python benchmarks/reroute.py run --work out/trials --trials 30 [--eyes cameras] [--gap 0.016] [--jobs 2]
        trials of both twins, seed by seed, with the same starts, goals and budgets; what is there is kept
    python benchmarks/reroute.py score --work out/trials
        the table, scores.json and report.html

A trial ends when the rope is through at two looks in a row (pred_core/plant/live/success.py), or when its time is up.
Starts with seeds below 1000 are for development, the final ones begin at 8000.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import shlex
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from argument_types import count
from measured_cables import identify, pred
from reroute_scores import write_scores
from reroute_trial import TrialConfig, run_trial, write_whole

from pred_core.bag.deform import claim_folder
from pred_core.cli.main import BAD_INPUT
from pred_core.config import from_mapping, to_mapping
from pred_core.errors import PredError
from pred_core.plan.task import load_settings
from pred_core.twin import Twin

SETTINGS = Path(__file__).parents[1] / "config" / "plan" / "slot.yaml"
TWINS = ("spring-mass", "pred")
FIRST = 8000  # seed of the first final trial
COLLECT = shlex.split("--episodes 10 3 0 --seconds 6 --mass 0.05 --radius 0.004 --seed 1")
SEARCH = shlex.split("--restarts 2 --evaluations 300")
EXTENDED = shlex.split("--parameters stiffness,damping,ground_friction,bending_stiffness --effects bending_damping")
TRAIN = shlex.split(
    "--azimuth --coordinates centered --carry 22 --rollout 4 --loss smooth --beta 0.3 --cap 0.02 --penalty 0.3 "
    "--average 0.98 --arc-frequencies 3 --encoder-layers 1 --feature 16 --encoder-feedforward 32 --hidden 32 "
    "--hidden-layers 1 --window 3 --embedding 16 --heads 2 --temporal-layers 1 --feedforward 32 --steps 300 "
    "--evaluate-every 50"
)


def main() -> int:
    """Run one of the commands."""
    torch.set_num_threads(1)
    args = _arguments()
    try:
        return int(args.act(args))
    except PredError as error:
        print(f"reroute: {error}", file=sys.stderr)
        return BAD_INPUT


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recipe = commands.add_parser("twin", help="record, identify and train both twins")
    recipe.set_defaults(act=make_twins)
    recipe.add_argument("--cable", type=count(0), default=0, help="0: the nominal cable; else the seed of a drawn one")
    run = commands.add_parser("run", help="the trials")
    run.set_defaults(act=run_trials)
    run.add_argument("--twin", choices=TWINS, action="append", help="default: both")
    run.add_argument("--trials", type=count(1), default=30)
    run.add_argument("--first", type=count(0), default=FIRST, help=f"first seed; default: {FIRST}")
    run.add_argument("--jobs", type=count(1, 256), default=os.cpu_count() or 1, help="trials at once")
    run.add_argument("--settings", default=str(SETTINGS), help="of the planner")
    for field in dataclasses.fields(TrialConfig):
        kind = type(field.default)
        text = f"{field.metadata['doc']} (default: {field.default} {field.metadata['unit']})"
        run.add_argument(f"--{field.name}", type=kind, default=field.default, help=text)
    score = commands.add_parser("score", help="the table of the trials that are there")
    score.set_defaults(act=lambda args: write_scores(args.work))
    for command in (recipe, run, score):
        command.add_argument("--work", type=Path, required=True, metavar="DIR", help="where everything stands")
    return parser.parse_args()


def make_twins(args: argparse.Namespace) -> int:
    """The recipe. What is there already is kept."""
    work: Path = args.work
    data = work / "data"
    if not (data / "dataset.yaml").exists():
        pred("plant", "collect", "--out", str(data), "--cable", str(args.cable), *COLLECT)
    identify(data, work / "spring-mass", ["--paper", *SEARCH])
    identify(data, work / "extended", [*EXTENDED, *SEARCH, "--base", str(work / "spring-mass")])
    if not (work / "pred" / "twin.yaml").exists():
        resume = ["--resume"] if list((work / "trained").glob("*.checkpoint.*")) else TRAIN
        if not (work / "trained" / "train.json").exists():
            pred("train", str(data), "--twin", str(work / "extended"), "--out", str(work / "trained"), *resume)
        trained = Twin.load(work / "trained")
        if not improved(work / "trained"):
            print("no step of the residual beat the physics on held-out recordings: `pred` goes without")
            trained = trained.replace(residual=None)
        trained.save(work / "pred")
    return 0


def improved(folder: Path) -> bool:
    """Whether training kept anything but the first weights, which add nothing."""
    return bool(json.loads((folder / "train.json").read_text(encoding="utf-8"))["best_step"])


def run_trials(args: argparse.Namespace) -> int:
    """Trials that are missing, seed by seed. Returns 1 if one failed."""
    values = {f.name: getattr(args, f.name) for f in dataclasses.fields(TrialConfig)}
    config = from_mapping(TrialConfig, values, "reroute run")
    left = []
    for seed in range(args.first, args.first + args.trials):
        for name in args.twin or TWINS:
            folder = trial_folder(args.work, name, config)
            claim_folder(folder, about(args.work / name, args.settings, config))
            path = folder / f"{seed}.json"
            if not path.exists():
                left.append((args.work / name, args.settings, config, seed, path, args.work / "goals"))
    failed = 0
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for job in as_completed([pool.submit(_trial, *one) for one in left]):
            line, good = job.result()
            failed += not good
            print(line, flush=True)
    return 1 if failed else 0


def trial_folder(work: Path, name: str, config: TrialConfig) -> Path:
    """Where the trials of a twin in one setting stand."""
    replan = "" if config.replan == TrialConfig.replan else f"-replan{config.replan:g}"
    return work / "trials" / f"{name}-{config.eyes}-gap{1e3 * config.gap:g}-cable{config.cable}{replan}"


def about(twin: Path, settings: str, config: TrialConfig) -> dict[str, Any]:
    """What the trials of a folder have in common; a folder takes no others."""
    return {
        "twin": twin.name,
        "twin_digest": Twin.load(twin).digest(),
        "settings": json.loads(json.dumps(to_mapping(load_settings(settings)))),
        "trial": to_mapping(config),
    }


def _trial(twin: Path, settings: str, config: TrialConfig, seed: int, path: Path, goals: Path) -> tuple[str, bool]:
    torch.set_num_threads(1)
    name = f"{path.parent.name} {seed}"
    try:
        result = run_trial(Twin.load(twin), load_settings(settings), config, seed, goals)
    except PredError as error:
        return f"{name}: failed: {error}", False
    write_whole(path, result)
    return f"{name}: {result['outcome']} after {result['time']:.1f} s, {result['cpu_seconds']:.0f} s of computing", True


if __name__ == "__main__":
    sys.exit(main())

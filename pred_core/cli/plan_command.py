"""`pred plan`: plan gripper motions that bring a twin's object to a goal cloud, without a robot."""

from __future__ import annotations

import argparse
import dataclasses
import math
import shlex
import sys
from pathlib import Path

import numpy as np

from pred_core.bag.dataset import FILE
from pred_core.cli.settings import parse_held
from pred_core.config import check_ranges
from pred_core.errors import ConfigError, InputError
from pred_core.plan.config import PlannerConfig
from pred_core.plan.endpoints import episode_cloud, episode_observation, episode_of, read_cloud, rest_observation
from pred_core.plan.latency import Observation
from pred_core.plan.offline import carry_out, settled
from pred_core.plan.plan import Plan
from pred_core.plan.report import write_report
from pred_core.plan.task import load_settings, make_planner, planning_dynamics, scene_with_slot
from pred_core.springmass.device import check_device
from pred_core.twin import Twin
from pred_core.types import Array

NAME = "plan"
HELP = "Plan gripper motions that bring a twin's object to a goal; writes plan.json and a report."


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of `pred plan`."""
    parser.add_argument("twin", type=Path, metavar="TWIN", help="folder of the twin")
    parser.add_argument("--goal", type=Path, metavar="CLOUD|DATASET", help=".npy, .csv, .txt, .xyz [m], or a data set")
    parser.add_argument("--goal-episode", metavar="NAME", help="of a data set; default: the start's, else the first")
    parser.add_argument("--goal-frame", type=int, default=-1, help="of that episode; default: the last")
    parser.add_argument("--shift", type=float, nargs=3, metavar=("DX", "DY", "DZ"), help="the goal, moved [m]")
    parser.add_argument("--start", type=Path, metavar="DATASET", help="plan from a measured state; default: at rest")
    parser.add_argument("--episode", metavar="NAME", help="of the start; default: the first")
    parser.add_argument("--frame", type=int, default=1, help="of the start; default: 1")
    parser.add_argument("--settle", type=float, default=0.0, help="let the start come to rest for this long first [s]")
    parser.add_argument("--held", help="particle:gripper pairs, e.g. '0:0 1:0'; default: the twin's")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for plan.json and plan.html")
    parser.add_argument("--settings", default="", metavar="YAML", help="as config/plan/slot.yaml; default: built in")
    parser.add_argument("--around", type=float, metavar="R", help="workspace: this far around the start's grippers [m]")
    parser.add_argument("--replans", type=int, default=5, help="plans, each from where the twin then is; default: 5")
    parser.add_argument("--step", type=float, default=0.5, help="of a plan that is carried out before the next [s]")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where motions are simulated")
    parser.add_argument("--seed", type=int, default=0, help="of the sampled motions")


def run(args: argparse.Namespace) -> int:
    """Plan, carry out in the twin's own simulation, write the report. Raises: PredError for unusable input."""
    for name, good, allowed in (
        ("replans", args.replans >= 1, "1 or more"),
        ("step", 0.0 < args.step < math.inf, "above 0 s"),
        ("seed", args.seed >= 0, "0 or more"),
        ("settle", 0.0 <= args.settle <= 60.0, "0 to 60 s"),
    ):
        if not good:
            raise ConfigError(f"--{name}", got=getattr(args, name), allowed=allowed)
    if args.goal is None and args.shift is None:
        raise InputError("no goal was given", next_step="Give --goal CLOUD or --shift DX DY DZ")
    check_device(args.device, "--device")
    twin = Twin.load(args.twin)
    seen = _start(args, twin)
    config = _settings(args, seen)
    scene = scene_with_slot(twin.scene, config)
    dynamics = planning_dynamics(twin, scene, args.device)
    seen = settled(dynamics, seen, args.settle)
    goal = _goal(args, seen)
    planner = make_planner(twin, goal, config, args.seed, dynamics=dynamics)

    def show(done: int, planned: int, plan: Plan) -> None:
        line = f"plan {done}/{planned}: cost {plan.cost:.4g} (standing still {plan.still:.4g})"
        print(f"{line}, {plan.motions} motions in {plan.seconds:.2f} s", file=sys.stderr, flush=True)

    result = carry_out(planner, dynamics, seen, args.replans, args.step, show)
    extra = {
        "object": twin.meta.object.name,
        "twin": str(args.twin),
        "twin_digest": twin.digest(),
        "residual": twin.residual is not None,
        "goal_points": len(goal),
        "seed": args.seed,
        "command": "pred " + shlex.join(sys.argv[1:]),
    }
    write_report(args.out, result, goal, scene, config, extra, twin.body.kind == "line")
    first, last = 1e3 * result.distance[0], 1e3 * result.distance[-1]
    print(f"{args.out / 'plan.html'}: {first:.1f} mm from the goal at the start, {last:.1f} mm at the end")
    return 0


def _start(args: argparse.Namespace, twin: Twin) -> Observation:
    if args.start is None:
        return rest_observation(twin, parse_held(args.held) if args.held else None)
    return episode_observation(twin, episode_of(args.start, args.episode), args.frame)


def _settings(args: argparse.Namespace, seen: Observation) -> PlannerConfig:
    config = load_settings(args.settings)
    if args.around is not None:
        if not 0.0 < args.around <= 3.0:
            raise ConfigError("--around", got=args.around, allowed="above 0 to 3 m")
        low, high = seen.position.min(axis=0) - args.around, seen.position.max(axis=0) + args.around
        motion = dataclasses.replace(
            config.motion, x_low=float(low[0]), y_low=float(low[1]), z_low=float(low[2]),
            x_high=float(high[0]), y_high=float(high[1]), z_high=float(high[2]),
        )  # fmt: skip
        config = dataclasses.replace(config, motion=motion)
        check_ranges(config.motion, "--around")
    return config


def _goal(args: argparse.Namespace, seen: Observation) -> Array:
    if args.goal is None:
        goal = seen.state.position.double().numpy()
    elif args.goal.name == FILE or (args.goal / FILE).is_file():
        same = args.start is not None and args.goal.resolve() == args.start.resolve()
        name = args.goal_episode if args.goal_episode or not same else args.episode
        goal = episode_cloud(episode_of(args.goal, name), args.goal_frame)
    else:
        goal = read_cloud(args.goal)
    return goal if args.shift is None else np.asarray(goal + np.array(args.shift))

"""`pred plant`: data sets of an independent world, with something hidden in it."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pred_core.bag.dataset import Dataset
from pred_core.cli.convert_command import progress_line
from pred_core.config import check_ranges
from pred_core.errors import ConfigError
from pred_core.plant.session import SessionConfig

if TYPE_CHECKING:
    from pred_core.plant.rope_case import Hidden
    from pred_core.plant.sensing import SensorConfig

NAME = "plant"
HELP = "Make data sets of an independent world (MuJoCo), with a hidden effect in it."


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of `pred plant`."""
    worlds = parser.add_subparsers(dest="world", required=True, metavar="WORLD")
    rope = worlds.add_parser("rope", help="a MuJoCo rope in the air and on a table")
    rope.add_argument("--effect", action="append", metavar="NAME", help="what is hidden; may be given twice; or none")
    about = "one an effect, in its unit; without, its least"
    rope.add_argument("--magnitude", action="append", type=float, metavar="M", help=about)
    about = "times the usual size of what is hidden: a range, a radius, a share of the rope (default: 1)"
    rope.add_argument("--extent", type=float, default=1.0, metavar="X", help=about)
    springs = worlds.add_parser("springs", help="springs like those of our simulator, finer: nothing is hidden")
    for world in (rope, springs):
        world.add_argument("--seed", type=int, default=0, help="motions, noise, directions and places")
        world.add_argument("--out", type=Path, required=True, metavar="DATASET", help="folder to write")
        world.add_argument("--episodes", type=int, nargs=3, default=(12, 6, 6), metavar=("TRAIN", "TEST", "OOD"))
        world.add_argument("--seconds", type=float, default=SessionConfig.seconds, help="of an episode")
        world.add_argument("--particles", type=int, default=SessionConfig.particles, help="tracked points")
        world.add_argument("--rate", type=float, help="of the tracks [Hz]; default 30")
        world.add_argument("--noise", type=float, help="of the tracks [m]; default 0.0007")
    _configure_cell(worlds)
    rope.set_defaults(make=_rope)
    springs.set_defaults(make=_springs)
    worlds.add_parser("effects", help="list the effects that can be hidden").set_defaults(make=_effects)


def _configure_cell(worlds: Any) -> None:
    cell = worlds.add_parser("collect", help="record random motions in the cell through cameras and tracker")
    cell.add_argument("--out", type=Path, required=True, metavar="DATASET", help="folder to write")
    cell.add_argument("--episodes", type=int, nargs=3, default=(12, 4, 4), metavar=("TRAIN", "TEST", "SLOT"))
    cell.add_argument("--seconds", type=float, default=8.0, help="of an episode")
    cell.add_argument("--rate", type=float, default=15.0, help="of cameras and tracks [Hz]")
    cell.add_argument("--seed", type=int, default=0, help="starts and motions")
    cell.add_argument("--cable", type=int, default=0, help="0: the nominal cable; else the seed of a drawn one")
    cell.add_argument("--gap", type=float, default=0.024, help="of the slot [m]")
    cell.add_argument("--mover", choices=("arm", "free"), default="arm", help="an arm, or a gripper without one")
    cell.add_argument("--mass", type=float, help="of the rope, if you weighed it [kg]")
    cell.add_argument("--radius", type=float, help="of the rope, if you measured it [m]")
    cell.add_argument("--pictures", action="store_true", help="keep the pictures in the bags, compressed")
    cell.set_defaults(make=_collect)
    sample = worlds.add_parser("sample", help="write the small bag of four cameras that ships in bags/")
    sample.add_argument("--out", type=Path, required=True, metavar="BAG", help="file to write, .mcap")
    sample.set_defaults(make=_sample)


def run(args: argparse.Namespace) -> int:
    """Make one data set; interrupted and started again, it goes on where it stopped. Or list the effects."""
    # MuJoCo is an extra: what needs it is imported only here and below, so that the other commands do without.
    if importlib.util.find_spec("mujoco") is None:
        raise ConfigError("the plant needs MuJoCo", got="no package mujoco", next_step="pip install mujoco==4.0.0")
    return int(args.make(args))


def _rope(args: argparse.Namespace) -> int:
    from pred_core.plant.rope_case import write_rope_case

    session, sensor = _settings(args)
    hidden = hidden_effects(args.effect or [], args.magnitude or [])
    dataset = write_rope_case(
        args.out, hidden, args.seed, progress_line(), session=session, sensor=sensor, extent=args.extent
    )
    return _report(dataset)


def _springs(args: argparse.Namespace) -> int:
    from pred_core.plant.springs import write_springs_case

    session, sensor = _settings(args)
    return _report(write_springs_case(args.out, args.seed, progress_line(), session=session, sensor=sensor))


def _collect(args: argparse.Namespace) -> int:
    from pred_core.cli.plant_collect import TrackerWatcher
    from pred_core.plant.live.campaign import CampaignConfig, collect
    from pred_core.plant.live.cell import CellConfig

    train, test, slot = args.episodes
    campaign = CampaignConfig(train, test, slot, args.seconds, args.rate, args.seed, args.pictures)
    cell = CellConfig(mover=args.mover, cable=args.cable)
    check_ranges(campaign, "pred plant collect")
    check_ranges(cell, "pred plant collect")
    measured = {name: value for name in ("mass", "radius") if (value := getattr(args, name)) is not None}
    dataset = collect(args.out, TrackerWatcher, progress_line(), campaign, cell, args.gap, measured)
    counts = ", ".join(f"{len(dataset.select(s))} {s}" for s in dataset.splits)
    print(f"{dataset.root}: {len(dataset.entries)} episodes ({counts})")
    return 0


def _sample(args: argparse.Namespace) -> int:
    from pred_core.plant.live.sample import write_camera_sample

    write_camera_sample(args.out)
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB")
    return 0


def _effects(args: argparse.Namespace) -> int:
    from pred_core.plant.hidden.library import LIBRARY

    print(f"{'effect':<22}{'family':<16}{'unit':<13}{'minimum':>9}{'range':>16}  law")
    for e in LIBRARY.values():
        mark = " (not meant to have a name)" if e.unlisted else ""
        print(f"{e.name:<22}{e.family:<16}{e.unit:<13}{e.minimum:>9g}{f'{e.low:g} to {e.high:g}':>16}  {e.law}{mark}")
    return 0


def hidden_effects(names: list[str], magnitudes: list[float]) -> Hidden:
    """Pairs of effect and magnitude; an effect without one gets its minimum. Raises: ConfigError."""
    from pred_core.plant.hidden.library import NONE, find_entry

    if names in ([], [NONE]):
        if any(magnitudes):
            raise ConfigError("--magnitude without an effect", got=magnitudes, next_step="Name one with --effect")
        return ()
    if NONE in names:
        raise ConfigError("--effect none", got=f"beside {', '.join(n for n in names if n != NONE)}", allowed="alone")
    entries = [find_entry(name) for name in names]
    if magnitudes and len(magnitudes) != len(entries):
        raise ConfigError("--magnitude", got=f"{len(magnitudes)} values", allowed=f"one an effect, {len(entries)}")
    return tuple((e.name, m) for e, m in zip(entries, magnitudes or [e.minimum for e in entries], strict=True))


def _settings(args: argparse.Namespace) -> tuple[SessionConfig, SensorConfig]:
    from pred_core.plant.sensing import SensorConfig

    train, test, ood = args.episodes
    session = SessionConfig(train, test, ood, args.seconds, args.particles)
    asked = {k: v for k, v in (("rate", args.rate), ("noise", args.noise)) if v is not None}
    sensor = dataclasses.replace(SensorConfig(), **asked)
    check_ranges(session, "pred plant")
    check_ranges(sensor, "pred plant")
    if train + test + ood < 1:
        raise ConfigError("--episodes", got=f"{train} {test} {ood}", allowed="at least one")
    if args.seed < 0:
        raise ConfigError("--seed", got=args.seed, allowed="0 or more")
    return session, sensor


def _report(dataset: Dataset) -> int:
    from pred_core.plant.case import truth_path

    counts = ", ".join(f"{len(dataset.select(s))} {s}" for s in dataset.splits)
    print(f"{dataset.root}: {len(dataset.entries)} episodes ({counts}); the truth stands in {truth_path(dataset.root)}")
    return 0

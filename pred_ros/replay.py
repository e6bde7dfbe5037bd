"""The main job in one command: a measured cable replayed as topics, predicted live, scored, reported.

`python -m pred_ros.replay` (or `pred_replay`, or `make run`) looks for measured data, tracks, converts and identifies
what is missing, runs player, predictor and evaluator, then `pred evaluate` for the full table.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pred_core.bag.dataset import FILE, load_dataset
from pred_core.bag.measured import find_measured
from pred_core.bag.playlist import find_clips
from pred_core.bag.wire import TRACKER_POINTS
from pred_core.cli.main import INTERRUPTED
from pred_core.errors import ConfigError, PredError
from pred_core.twin import Twin
from pred_ros.commands import run_command
from pred_ros.live import Replay, replay
from pred_ros.resources import config_folder, sample_dataset, sample_pictures

MEASURED = ("deform_dlo2", "deform_dlo1")  # in this order
PICTURES_TWIN, PICTURES_SETTINGS = "cell_rope", "nodes/reroute.yaml"  # in config/: of the bundled bag of cameras
PICTURES_OBJECT = "rope"
PICTURES_HELD = "0:0 1:0"  # the jaws hold the rope's end, and its direction
SAMPLE = "bundled and synthetic; no measured data found (set PRED_DATA to their folder)"
TWIN_FILE = "twin.yaml"


@dataclass(frozen=True)
class Source:
    """Where the data come from."""

    name: str
    path: Path  # an .npz to convert, a data set, or pictures to track: a bag, or a data set of such bags
    origin: str  # said to the user
    pictures: bool = False
    settings: Path | None = None  # of the tracker
    object: str = ""  # its name, in pictures; default: the source's
    held: str = ""  # particle:gripper pairs, for pictures
    twin: Path | None = None  # the one it is meant for


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns 0 done, 2 bad input, 130 interrupted."""
    args = _parser().parse_args(argv)
    return run_command("pred_replay", lambda: run(args))


def run(args: argparse.Namespace) -> int:
    """Choose, prepare, replay, evaluate, and say where everything is. Returns 0. Raises: PredError."""
    source = sample_source() if args.cameras else choose_source(args.dataset, args.settings)
    if args.settings is not None and (args.cameras or not source.pictures):
        raise ConfigError(
            "--settings are the tracker's, for pictures of your own",
            got=f"{args.settings} for {source.name}",
            allowed="beside --dataset with a bag of pictures, or a data set of such bags",
        )
    if args.twin is not None:
        Twin.load(args.twin)  # before data are converted and nodes started
    out = args.out / source.name
    print(f"1. data: {source.name}, {source.origin}: {source.path}", flush=True)
    dataset = prepare_dataset(source, args.out / "datasets" / source.name)
    twin = args.twin or source.twin or prepare_twin(source, dataset, args.out / "twins" / source.name)
    print(f"2. twin: {twin}", flush=True)
    names = episode_names(dataset, args.split, args.episodes)
    print(f"3. replay of {len(names)} episodes at {args.factor:g} x real time over ROS 2 topics", flush=True)
    job = Replay(dataset, twin, out / "live", split=args.split, episodes=names, factor=args.factor)
    metrics = replay(job)
    for entry in metrics["entries"]:
        table = entry["metrics"]
        l1, mde = (table[m]["all_steps"]["mean"] for m in ("coordinate_l1", "mde"))
        print(f"   live, {entry['split']}: coordinate_l1 {1e2 * l1:.3f} cm, mde {1e3 * mde:.2f} mm", flush=True)
    print(f"   {metrics['frames']['lost']} of {metrics['frames']['announced']} frames lost", flush=True)
    if not args.live_only:
        print("4. full table", flush=True)
        command("evaluate", str(dataset), "--twin", str(twin), "--out", str(out / "evaluate"))
    print("\nreports:")
    print(f"   live replay   {out / 'live' / 'report.html'}")
    if not args.live_only:
        print(f"   evaluation    {out / 'evaluate' / 'report.html'}")
    return 0


def choose_source(dataset: Path | None, settings: Path | None = None) -> Source:
    """The data set or bag of pictures given, else measured data, else the bundled sample. Raises: PredError."""
    if dataset is not None:
        is_bag = not (dataset / FILE).is_file() and (dataset.is_file() or any(dataset.glob("*.mcap")))
        pictures = (is_bag or load_dataset(dataset)) and TRACKER_POINTS not in find_clips(dataset)[0].topics
        name = dataset.stem if is_bag and pictures else load_dataset(dataset).object.name
        origin = "given, pictures to be tracked" if pictures else "given"
        return Source(name, dataset, origin, bool(pictures), settings)
    for name in MEASURED:
        found = find_measured(name)
        if found is not None:
            return Source(name, found, "measured data")
    return Source("sample_cable", sample_dataset(), SAMPLE)


def sample_source() -> Source:
    """The bundled bag of four cameras, with the tracker's settings and the twin of its cell. Raises: PredError."""
    config = config_folder()
    return Source(
        "sample_cameras",
        sample_pictures(),
        "bundled and synthetic: four cameras, pictures to be tracked",
        pictures=True,
        settings=config / PICTURES_SETTINGS,
        object=PICTURES_OBJECT,
        held=PICTURES_HELD,
        twin=config / "twins" / PICTURES_TWIN,
    )


def prepare_dataset(source: Source, folder: Path) -> Path:
    """The data set of a source, tracked or converted into `folder` if it is not one yet. Raises: PredError."""
    if source.pictures:
        options = ["--settings", str(source.settings)] if source.settings is not None else []
        options += ["--held", source.held] if source.held else []
        command("track", str(source.path), "--out", str(folder), "--name", source.object or source.name, *options)
        return folder
    if (source.path / FILE).is_file():
        return source.path
    if not (folder / FILE).is_file():
        command("convert", "deform", str(source.path), "--out", str(folder))
    return folder


def prepare_twin(source: Source, dataset: Path, folder: Path) -> Path:
    """The twin that ships for this object, else one identified now. Raises: PredError."""
    shipped = config_folder() / "twins" / source.name
    if (shipped / TWIN_FILE).is_file():
        return shipped
    if not (folder / TWIN_FILE).is_file():
        command("identify", str(dataset), "--out", str(folder))
    return folder


def episode_names(dataset: Path, split: str, most: int) -> tuple[str, ...]:
    """The first episodes of a split. Raises: PredError if it is empty."""
    chosen = load_dataset(dataset).select(None if split == "all" else split)
    return tuple(Path(e.bag).stem for e in chosen[:most])


def command(*arguments: str) -> None:
    """Run `pred ...` so that its progress is seen. Raises: PredError if it fails; its own line says why."""
    code = subprocess.run([sys.executable, "-m", "pred_core.cli.main", *arguments], check=False).returncode
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    if code != 0:
        raise PredError(f"'pred {' '.join(arguments)}' failed with code {code}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="pred_replay", description=__doc__.splitlines()[0] if __doc__ else "")
    data = parser.add_mutually_exclusive_group()
    data.add_argument(
        "--dataset", type=Path, help="data set, or a bag of pictures; default: measured data, else the sample"
    )
    data.add_argument("--cameras", action="store_true", help="the bundled bag of four RGB-D cameras")
    parser.add_argument("--settings", type=Path, metavar="YAML", help="of the tracker, for pictures")
    parser.add_argument("--twin", type=Path, help="twin folder; default: the one that ships, else identify one")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for everything that is written")
    parser.add_argument("--split", default="test", choices=("all", "train", "test", "ood"), help="episodes to replay")
    parser.add_argument("--episodes", type=int, default=6, metavar="N", help="at most this many episodes")
    parser.add_argument("--factor", type=float, default=1.0, metavar="X", help="speed, times real time")
    parser.add_argument("--live-only", action="store_true", help="skip the full table of pred evaluate")
    return parser


if __name__ == "__main__":
    sys.exit(main())

"""`pred track`: recorded pictures of RGB-D cameras into a data set of tracks."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from pred_core.bag.playlist import find_clips
from pred_core.cli.convert_command import progress_line
from pred_core.cli.settings import add_settings, parse_held, read_settings
from pred_core.errors import ConfigError
from pred_core.track.recorded import camera_names, track_dataset
from pred_core.track.settings import TrackerSettings, read_settings_file

NAME = "track"
HELP = "Track a recorded object in the pictures of a bag, or of every bag of a data set; writes a data set."


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of `pred track`."""
    parser.add_argument("source", type=Path, metavar="BAG|DATASET", help="with pictures, camera poses and a gripper")
    parser.add_argument("--out", type=Path, required=True, metavar="DATASET", help="folder to write")
    parser.add_argument(
        "--settings", type=Path, metavar="YAML", help="the node's parameters, as config/nodes/tracker.yaml"
    )
    parser.add_argument("--name", default="object", help="of the object, where the source is a bag (default: object)")
    parser.add_argument(
        "--held", help="particle:gripper pairs, e.g. '0:0 1:0'; default: the source's, else what the jaws hold at first"
    )
    add_settings(parser, TrackerSettings)


def run(args: argparse.Namespace) -> int:
    """Track, write, and say how much was seen. Raises: PredError."""
    first = find_clips(args.source, points=False)[0]
    values: dict[str, Any] = {"cameras": " ".join(camera_names(first))}
    if first.kind:
        values["kind"] = first.kind
    if args.settings is not None:
        values |= read_settings_file(args.settings)
    settings = read_settings(args, TrackerSettings, "pred track", values)
    if first.kind and settings.kind != first.kind:
        what = f"{args.source}: its object is a {first.kind}"
        raise ConfigError(what, got=f"kind {settings.kind}", allowed=first.kind)
    held = parse_held(args.held) if args.held is not None else None
    dataset, counts = track_dataset(args.source, settings, args.out, args.name, progress_line(), held)
    for count in counts:
        print(f"{count.name}: the {settings.kind} found in {count.found} of {count.instants} instants")
        for line, times in count.refused.items():
            print(f"pred: {count.name}: {times} pictures not used: {line}", file=sys.stderr)
    episodes = f"{len(dataset.entries)} episode{'s' if len(dataset.entries) > 1 else ''}"
    print(f"{dataset.root}: {episodes} at {dataset.rate:g} Hz; what is in it: pred info {dataset.root}")
    return 0

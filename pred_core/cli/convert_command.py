"""`pred convert`: other data formats into a data set of bags."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from pred_core.bag.beam import convert_beam, read_beam
from pred_core.bag.deform import Progress, convert_deform, read_deform
from pred_core.bag.measured import measured_or_explain
from pred_core.bag.sample import write_sample

NAME = "convert"
HELP = "Convert measured data of other projects into a data set of bags."
_PLACES = "if it is not there, it is looked for in PRED_DATA, data/ and ../shared/data"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of `pred convert`."""
    formats = parser.add_subparsers(dest="format", required=True, metavar="FORMAT")
    deform = formats.add_parser("deform", help="the measured cables of DEFORM (arXiv 2406.05931)")
    files = "deform_dlo1.npz, or a folder with train/*.pkl and eval/*.pkl"
    deform.add_argument("source", type=Path, help=f"{files}; {_PLACES}")
    deform.add_argument("--out", type=Path, required=True, metavar="DATASET", help="folder to write")
    deform.set_defaults(convert=_deform)
    beam = formats.add_parser("beam", help="the released soft beam of srl-ethz/diffPD_sim2real")
    beam.add_argument("source", type=Path, help=f"soft_beam.npz; {_PLACES}")
    beam.add_argument("--load", type=int, default=0, metavar="GRAMS", help="takes with this load: 0 or 52")
    beam.add_argument("--out", type=Path, required=True, metavar="DATASET", help="folder to write")
    beam.set_defaults(convert=_beam)
    sample = formats.add_parser("sample", help="make the synthetic sample cable of bags/sample_cable")
    sample.add_argument("--out", type=Path, required=True, metavar="DATASET", help="folder to write")
    sample.set_defaults(convert=_sample)


def run(args: argparse.Namespace) -> int:
    """Run one conversion; interrupted and started again, it goes on where it stopped."""
    return int(args.convert(args))


def _deform(args: argparse.Namespace) -> int:
    source = read_deform(_found(args.source))
    dataset = convert_deform(source, args.out, progress_line())
    counts = ", ".join(f"{len(dataset.select(s))} {s}" for s in dataset.splits)
    recordings = len(set(source.recording))
    print(f"{dataset.root}: {len(dataset.entries)} episodes ({counts}) of {recordings} recordings")
    print(f"data gate: pred info {dataset.root}")
    return 0


def _beam(args: argparse.Namespace) -> int:
    source = read_beam(_found(args.source), args.load)
    dataset = convert_beam(source, args.out, progress_line())
    print(f"{dataset.root}: {len(dataset.entries)} episodes of {len(source.takes)} takes with {source.load} g")
    print("between clamp and tip nothing was measured: particles there are estimated, and never scored")
    return 0


def _found(source: Path) -> Path:
    """The path as given, else where measured data are. Raises: DatasetError, ConfigError (PRED_DATA is no folder)."""
    return source if source.exists() or source.is_absolute() else measured_or_explain(str(source))


def _sample(args: argparse.Namespace) -> int:
    dataset = write_sample(args.out, progress_line())
    print(f"{dataset.root}: {len(dataset.entries)} synthetic episodes")
    return 0


def progress_line() -> Progress:
    """Prints done, total and the time left on stderr: in place on a terminal, else every tenth part."""
    begin = time.monotonic()
    terminal = sys.stderr.isatty()

    def show(done: int, total: int, name: str) -> None:
        left = (time.monotonic() - begin) / done * (total - done)
        line = f"{done}/{total} {name}, about {left:.0f} s left"
        if terminal:
            print(f"\r{line:<60}", end="\n" if done == total else "", file=sys.stderr, flush=True)
        elif done == total or done % max(total // 10, 1) == 0:
            print(line, file=sys.stderr, flush=True)

    return show

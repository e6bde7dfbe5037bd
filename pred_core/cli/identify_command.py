"""`pred identify`: fit a twin's physics to the train split of a data set."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from pathlib import Path

from pred_core.bag.dataset import load_dataset
from pred_core.cli.settings import add_settings, given_settings, read_settings
from pred_core.identify.config import PAPER, IdentifyConfig
from pred_core.identify.report import DEFINITIONS, flags, write_report
from pred_core.identify.run import identify, train_episodes
from pred_core.identify.space import search_space
from pred_core.twin import Twin
from pred_core.types import Physics

NAME = "identify"
HELP = "fit a twin's physics to the train episodes of a data set (paper III-A)"
JOURNAL = "identify.journal.jsonl"
QUIET_SECONDS = 2.0  # between progress lines where stderr is no terminal


def configure(parser: argparse.ArgumentParser) -> None:
    """Flags: the files, and one flag for every field of the configuration."""
    parser.add_argument("dataset", type=Path, help="data set folder; its train split is used")
    parser.add_argument("--out", type=Path, required=True, metavar="TWIN", help="twin to write")
    text = "twin identified with fewer effects, kept inside as the spring-mass to compare with"
    parser.add_argument("--base", type=Path, metavar="TWIN", help=text)
    parser.add_argument("--paper", action="store_true", help="search the paper's five parameters alone")
    add_settings(parser, IdentifyConfig)


def run(args: argparse.Namespace) -> int:
    """Identify, write the twin, `identify.json` and `identify.html`.

    Interrupted and run again, the search goes on where it stopped; the refinement starts again.
    """
    config = _config(args)
    _check_names(config)
    dataset = load_dataset(args.dataset)
    base = None if args.base is None else Twin.load(args.base)
    show = _Progress()
    journal = args.out / JOURNAL
    if journal.is_file():
        show(f"resuming: going on with the search in {journal}; the refinement starts again")
    command = shlex.join(["pred", "identify", str(args.dataset), "--out", str(args.out), *_given(args)])
    result = identify(dataset, train_episodes(dataset), config, journal, show, command)
    show.end()
    result.twin.replace(base=base).save(args.out)
    summary = {**result.summary(), "definitions": DEFINITIONS}
    (args.out / "identify.json").write_text(json.dumps(summary, indent=1), encoding="utf-8")
    write_report(args.out / "identify.html", result, command)
    journal.unlink()  # last: until everything is written, the search can be gone on with
    for name, entry in result.values.items():
        said = flags(entry)
        print(f"{name:32} {entry['value']:.5g} {entry['unit']}{f'  ({said})' if said else ''}")
    print("mean error per coordinate of free particles, best 90 % of windows:")
    print(f"  {result.fitted_mm:.2f} mm on all train recordings, which it was fitted on")
    if result.held_out_mm is not None:
        print(f"  {result.held_out_mm:.2f} mm on recordings held out, before the last refit on all of them")
    if result.left_out:
        print(f"left out as outliers, look for damaged tracks: {', '.join(result.left_out)}")
    print(f"wrote {args.out} and {args.out / 'identify.html'} in {result.seconds:.0f} s")
    return 0


class _Progress:
    """One line on stderr: rewritten on a terminal, else printed when a stage begins and every two seconds."""

    def __init__(self) -> None:
        self.terminal = sys.stderr.isatty()
        self.last = 0.0
        self.stage = ""

    def __call__(self, line: str) -> None:
        now, stage = time.monotonic(), line.split(":", 1)[0]
        begins = stage != self.stage or stage not in ("search", "refine")
        if self.terminal:
            if begins:
                self.end()
            print(f"\r{line:<100}", end="", file=sys.stderr, flush=True)
        elif begins or now - self.last > QUIET_SECONDS:
            self.last = now
            print(line, file=sys.stderr, flush=True)
        self.stage = stage

    def end(self) -> None:
        """Leave the line."""
        if self.terminal and self.stage:
            print(file=sys.stderr)


def _config(args: argparse.Namespace) -> IdentifyConfig:
    """The configuration the flags describe. Raises: ConfigError naming the flag."""
    values = {"parameters": PAPER} if args.paper else {}
    config: IdentifyConfig = read_settings(args, IdentifyConfig, "pred identify", values)
    return config


def _check_names(config: IdentifyConfig) -> None:
    """Refuse unknown names before bags are read."""
    search_space(Physics(), config.parameters, config.effects)


def _given(args: argparse.Namespace) -> list[str]:
    flags = ["--paper"] if args.paper else []
    flags += ["--base", str(args.base)] if args.base is not None else []
    return [*flags, *given_settings(args, IdentifyConfig)]

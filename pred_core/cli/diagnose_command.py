"""`pred diagnose`: what a twin gets wrong on measured data, and a twin that has it; diagnosis.json and report.html."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from pred_core.bag.dataset import Dataset, load_dataset
from pred_core.cli.checks import warn_of_another_object
from pred_core.cli.network_guard import question, question_or_say
from pred_core.cli.settings import add_settings, given_settings, read_settings
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.fits import check_tracks
from pred_core.diagnose.job import check_gravity, differences, job_of
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.motion_file import for_the_arm, write_motion
from pred_core.diagnose.out_folder import (
    JOURNAL,
    TWIN,
    check_guard_out,
    check_out,
    remove_guard,
    results_in,
    said_of_earlier,
)
from pred_core.diagnose.report import write_report
from pred_core.diagnose.report_network import read_network
from pred_core.diagnose.result import Diagnosis
from pred_core.diagnose.run import diagnose
from pred_core.errors import BagError, ConfigError, DatasetError
from pred_core.evaluate.report import write_json
from pred_core.twin import Twin
from pred_core.types import Episode

NAME = "diagnose"
HELP = "find what a twin's simulation gets wrong, name the cause, extend the twin and measure the gain"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path, help="data set folder")
    parser.add_argument("--twin", type=Path, required=True, help="twin directory that is questioned")
    parser.add_argument("--reference", type=Path, default=None, metavar="DATASET",
                        help="data set of the same object without the effect: the change is diagnosed")
    parser.add_argument("--out", type=Path, required=True, help="output folder; an interrupted run goes on there")
    parser.add_argument("--guard", action="store_true",
                        help="only ask whether the twin's network hides a cause: guard.json and guard.html; no other "
                        "option goes with it")
    parser.add_argument("--network", type=Path, default=None, metavar="FILE",
                        help="errors with and without a network to show in the report (benchmarks/network_2x2.py)")
    add_settings(parser, DiagnoseConfig)


def run(args: argparse.Namespace) -> int:
    """Exit code 0 whatever the outcome; raises PredError for bad input."""
    begin = time.monotonic()
    if args.guard:
        _check_guard_alone(args)
    config: DiagnoseConfig = read_settings(args, DiagnoseConfig, "pred diagnose")
    dataset = load_dataset(args.dataset)
    twin = Twin.load(args.twin)
    warn_of_another_object(twin, dataset, str(args.twin))
    if args.guard:
        check_guard_out(args.out, dataset.root)
        check_gravity(dataset, None, twin, args.twin)
        asked = _unseen(dataset)
        check_tracks(asked, (), twin)
        lines = question(twin, asked, args.out, args.dataset, args.twin)[1]
        print("\n".join([*lines, str(args.out / "guard.html")]))
        return 0
    network = None if args.network is None else read_network(args.network)
    reference = None if args.reference is None else load_dataset(args.reference)
    tell = _Progress(begin)
    journal = _journal(args, dataset, reference, twin, config, tell)
    episodes = _read(dataset, "")
    known = None if reference is None else _read(reference, "reference ")
    answer = diagnose(episodes, twin, known, config, tell, journal=journal, begin=begin)
    command = "pred " + shlex.join(_words(args))
    meta = dataclasses.replace(answer.twin.meta, created_by=command)
    answer.twin.replace(meta=meta).save(args.out / TWIN)
    write_json(args.out / "diagnosis.json", {**answer.to_json(), "command": command})
    _write_next_motion(args.out / "next_motion.yaml", answer)
    guard = None
    if twin.residual is None:
        remove_guard(args.out)
    else:
        guard = question_or_say(twin, _unseen(dataset), args.out, args.dataset, args.twin, tell)
    write_report(args.out / "report.html", answer, episodes, known, command, network, guard)
    print(answer.sentence)
    for row in answer.ranking[:5]:
        print(f"  {row.probability:5.2f}  {row.id:24s} {row.rejected}")
    print(f"{args.out / 'report.html'}  {args.out / 'diagnosis.json'}  {args.out / TWIN}  ({answer.seconds:.0f} s)")
    return 0


def _read(dataset: Dataset, which: str) -> list[Episode]:
    """All episodes; what is wrong with one is said with its data set: two may have bags of one name."""
    try:
        return list(dataset.episodes())
    except (BagError, DatasetError) as error:
        raise type(error)(f"{which}{dataset.root}: {error}") from error


def _check_guard_alone(args: argparse.Namespace) -> None:
    """Raise ConfigError for options that the question about the network would not heed."""
    more = _words(args)[len(_needed(args)) :]
    if more:
        raise ConfigError(
            "--guard only asks about the twin's network",
            got=shlex.join(more),
            allowed="DATASET, --twin and --out",
            next_step="Leave out --guard to diagnose, or the other options to ask",
        )


def _unseen(dataset: Dataset) -> list[Episode]:
    """Episodes that a network is questioned on: those of the motions it is for. Raises: DatasetError without any."""
    found = [e for e in dataset.episodes() if e.split != "ood"]
    if not found:
        raise DatasetError(
            f"{dataset.root}: nothing to question a network on",
            got="episodes with split 'ood' only",
            allowed="train or test episodes of 2 recordings or more",
        )
    return found


def _write_next_motion(path: Path, answer: Diagnosis) -> None:
    """The motion that would tell causes apart; the one of an earlier answer in the folder goes."""
    if answer.next_motion is None:
        path.unlink(missing_ok=True)
    else:
        write_motion(path, answer.next_motion)
        needs = for_the_arm(answer.next_motion)
        told = f"; the arm node needs {needs} for it, where that is safe" if needs else ""
        print(f"to tell more, record: {answer.next_motion['name']} ({path}{told})")


def _journal(
    args: argparse.Namespace,
    dataset: Dataset,
    reference: Dataset | None,
    twin: Twin,
    config: DiagnoseConfig,
    tell: _Progress,
) -> Journal:
    """The journal in the output folder, once the inputs fit together and the folder may be written to."""
    data = {"the data set": dataset.root}
    if reference is not None:
        data["the reference"] = reference.root
    check_out(args.out, args.twin, data)
    check_gravity(dataset, reference, twin, args.twin)
    job = job_of(dataset, reference, twin, config)

    def put_aside(aside: Path, before: dict[str, Any] | None) -> None:
        tell(said_of_earlier(args.out, aside, differences(before, job)))

    journal = Journal(args.out / JOURNAL, job, put_aside)
    if results_in(args.out) and not journal.found:
        tell(said_of_earlier(args.out, None, ""))
    return journal


def _needed(args: argparse.Namespace) -> list[str]:
    return ["diagnose", str(args.dataset), "--twin", str(args.twin), "--out", str(args.out)]


def _words(args: argparse.Namespace) -> list[str]:
    words = _needed(args)
    if args.reference is not None:
        words += ["--reference", str(args.reference)]
    if args.network is not None:
        words += ["--network", str(args.network)]
    return [*words, *given_settings(args, DiagnoseConfig)]


class _Progress:
    """Lines on stderr with the time passed."""

    def __init__(self, begin: float):
        self.begin = begin

    def __call__(self, text: str) -> None:
        print(f"[{time.monotonic() - self.begin:5.0f} s] {text}", file=sys.stderr)

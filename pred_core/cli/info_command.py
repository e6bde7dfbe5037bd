"""`pred info`: what a bag or a data set holds, what is missing, what looks wrong."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from pred_core.bag.dataset import FILE, load_dataset
from pred_core.bag.summary import BagSummary, DatasetSummary, summarize_bag, summarize_dataset
from pred_core.cli.convert_command import progress_line

NAME = "info"
HELP = "Show what a bag or a data set holds, what is missing and what looks wrong."
NOT_READY = 1  # exit code: it was read, but breaks the contract
CHECKED = (
    "checked: every message of the required topics; time runs forwards, no long gap, a pose and a closed flag for "
    "every frame. Not checked here: rate, held particles and data gate, which need the data set"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of `pred info`."""
    parser.add_argument("path", type=Path, metavar="BAG|DATASET", help="an .mcap file, a recorded folder or a data set")
    parser.add_argument("--json", action="store_true", help="machine readable")


def run(args: argparse.Namespace) -> int:
    """Print the report. Returns 0 if the data can be used as they are, 1 if the report lists problems."""
    summary: BagSummary | DatasetSummary
    if args.path.name == FILE or (args.path / FILE).is_file():
        summary = summarize_dataset(load_dataset(args.path), progress_line())
        lines = _dataset_lines(summary)
    else:
        summary = summarize_bag(args.path)
        lines = _bag_lines(summary)
    print(json.dumps(dataclasses.asdict(summary), indent=2) if args.json else "\n".join(lines))
    return NOT_READY if summary.problems else 0


def _bag_lines(s: BagSummary) -> list[str]:
    lines = [f"{s.path}: {s.messages} messages, {s.seconds:.2f} s, {s.bytes / 1e6:.2f} MB", ""]
    lines.append(f"{'topic':<28}{'type':<36}{'count':>7}{'rate Hz':>9}{'jitter':>8}{'lost':>6}{'gap ms':>8}  clock")
    for t in s.topics:
        lines.append(
            f"{t.topic:<28}{t.type:<36}{t.count:>7}{t.rate:>9.2f}{t.jitter:>8.1%}{t.lost:>6}{t.largest_gap * 1e3:>8.1f}"
            f"  {t.clock}" + (f", {t.backwards} steps back" if t.backwards else "")
        )
    if s.low and s.high:
        box = ", ".join(f"{a} {lo:.3f} to {hi:.3f}" for a, lo, hi in zip("xyz", s.low, s.high, strict=True))
        lines += ["", f"{s.particles} particles, {s.hidden:.1%} hidden, in {box} m; {s.grippers} grippers"]
    if s.cameras:
        lines.append(f"cameras: {', '.join(s.cameras)}")
    checked = () if s.problems else ("", CHECKED)
    return [*lines, *checked, *_problem_lines(s.problems)]


def _dataset_lines(s: DatasetSummary) -> list[str]:
    splits = ", ".join(f"{n} {name}" for name, n in s.splits.items())
    noise = "unknown" if s.sigma is None else f"{s.sigma * 1e3:g} mm"
    lines = [
        f"{s.path}: {s.object} ({s.kind}), {s.rate:g} Hz, {s.seconds:.0f} s, track noise {noise}",
        f"{splits}; {s.recordings} recordings",
    ]
    if s.known:
        lines.append("known: " + ", ".join(f"{k} {v}" for k, v in s.known.items()))
    if s.shared_recordings:
        lines.append(
            f"{len(s.shared_recordings)} recordings have episodes in train and in test: this split leaks, "
            "compare with folds grouped by recording"
        )
    width = max([14, *(len(q.name) + 1 for q in s.episodes)])
    columns = f"{'split':<7}{'rec':>4}{'frames':>8}{'stretch':>9}{'m/s':>6}{'hidden':>8}  data gate"
    lines += ["", f"{'episode':<{width}}{columns}"]
    for q in s.episodes:
        lines.append(
            f"{q.name:<{width}}{q.split:<7}{q.recording:>4}{q.frames:>8}{q.stretch_max:>9.1%}{q.speed_max:>6.1f}"
            f"{q.hidden:>8.1%}  {'; '.join(q.flags) or '-'}"
        )
    flagged = sum(bool(q.flags) for q in s.episodes)
    lines.append(f"{flagged} of {len(s.episodes)} episodes are flagged; none is left out")
    return lines + _problem_lines(s.problems)


def _problem_lines(problems: list[str]) -> list[str]:
    if not problems:
        return ["", "ready for pred identify"]
    return ["", "not ready for pred identify:", *(f"  - {p}" for p in problems)]

"""`pred train`: learn the residual velocity of a twin from the train split of a data set."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar, get_type_hints

from pred_core.bag.dataset import Dataset, load_dataset
from pred_core.cli.checks import warn_of_another_object
from pred_core.cli.network_guard import question_or_say
from pred_core.config import from_mapping
from pred_core.errors import ConfigError
from pred_core.pred import load_base
from pred_core.residual import ResidualConfig
from pred_core.springmass.device import check_device
from pred_core.train import Trainer, TrainingConfig, align
from pred_core.train.checkpoint import load_checkpoint, read_facts
from pred_core.train.outliers import leave_out
from pred_core.train.report import write_report
from pred_core.train.run import CHECKPOINT_SECONDS, run_training
from pred_core.twin import Twin
from pred_core.types import Episode

NAME = "train"
HELP = "learn the residual velocity of a twin (paper III-B, III-C)"
CHECKPOINT = "train.checkpoint.safetensors"
INTERRUPTED = 130
C = TypeVar("C")


def configure(parser: argparse.ArgumentParser) -> None:
    """Flags: the files, and one flag for every field of the two configurations."""
    parser.add_argument("dataset", type=Path, help="data set folder; its train split is used")
    parser.add_argument("--twin", type=Path, required=True, help="identified twin; a residual it has is replaced")
    parser.add_argument("--out", type=Path, help="twin to write (default: the same twin)")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the output twin")
    parser.add_argument("--restart", action="store_true", help="throw that checkpoint away")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")
    parser.add_argument("--guard", action=argparse.BooleanOptionalAction, default=True,
                        help="ask afterwards whether the network hides a cause that the simulation lacks (guard.json)")
    text = f"time between checkpoints [s] (default: {CHECKPOINT_SECONDS:g})"
    parser.add_argument("--checkpoint-seconds", type=float, default=CHECKPOINT_SECONDS, help=text)
    for title, config in (("training", TrainingConfig), ("network", ResidualConfig)):
        group = parser.add_argument_group(title)
        for field in dataclasses.fields(config):
            _add_flag(group, field, get_type_hints(config)[field.name])


def run(args: argparse.Namespace) -> int:
    """Train, write the twin and the report. Returns 0, or 130 after an interrupt (a checkpoint is left)."""
    out: Path = args.out or args.twin
    checkpoint = out / CHECKPOINT
    check_device(args.device, "--device")
    facts = _facts_to_resume(checkpoint, args.resume, args.restart)
    training = _config(TrainingConfig, args, facts["training"] if facts else {})
    network = _config(ResidualConfig, args, facts["network"] if facts else {})
    dataset = load_dataset(args.dataset)
    twin = Twin.load(args.twin).replace(residual=None)
    warn_of_another_object(twin, dataset, str(args.twin))
    hashes = [dataset.sha256(entry) for entry in dataset.select("train")]
    source = {"twin": twin.digest(), "data": hashlib.sha256("".join(sorted(hashes)).encode()).hexdigest()}
    trainer = build_trainer(dataset, twin, training, network, args.device)
    if facts is not None:
        load_checkpoint(checkpoint, trainer, source)
        _tell(f"resumed at step {trainer.step}")
    with _stop_flag() as stopped:
        done = run_training(trainer, checkpoint, source, lambda: bool(stopped), _tell, args.checkpoint_seconds)
    if not done:
        _tell(f"stopped after step {trainer.step}; go on with --resume")
        return INTERRUPTED
    files = [str(args.dataset), "--twin", str(args.twin), "--out", str(out), "--device", args.device]
    command = shlex.join(["pred", "train", *files, *_flags(training), *_flags(network)])
    data = tuple(dict.fromkeys((*twin.meta.data, *hashes)))  # the backbone's bags count as seen too
    meta = dataclasses.replace(twin.meta, created_by=command, parent=source["twin"], data=data)
    twin = twin.replace(residual=trainer.chosen().weights(), meta=meta)
    twin.save(out)
    write_report(out, trainer.summary(), command)
    checkpoint.unlink()
    if trainer.best_step == 0:
        _tell("kept the first weights: no step beat the backbone on held-out recordings; train longer or use more data")
    _tell(f"wrote {out} and {out / 'train.html'}")
    if args.guard:
        kept = {r.name for r in (*trainer.fit, *trainer.held_out)}
        trained_on = [e for e in dataset.episodes("train") if e.name in kept]
        question_or_say(twin, trained_on, out, args.dataset, out, _tell)
    return 0


def build_trainer(
    dataset: Dataset, twin: Twin, training: TrainingConfig, network: ResidualConfig, device: str
) -> Trainer:
    """The trainer on the train split, the twin's simulator as its base."""
    episodes: list[Episode] = list(dataset.episodes("train"))
    recordings = [align(episode, twin.body, twin.meta.period, twin.calibration) for episode in episodes]
    base = load_base(twin, device)
    kept, left_out = leave_out(base, recordings, training.outlier)
    for out in left_out:
        _tell(f"left out {out.name}: backbone error {out.error_mm:.2f} mm, median {out.median_mm:.2f} mm (--outlier)")
    trainer = Trainer(base, twin.body, kept, training, network, twin.scene.gravity, device)
    trainer.left_out = left_out
    return trainer


def _facts_to_resume(checkpoint: Path, resume: bool, restart: bool) -> dict[str, Any] | None:
    if resume and restart:
        raise ConfigError("--resume and --restart exclude each other")
    if resume:
        if not checkpoint.is_file():
            raise ConfigError(f"{checkpoint}: nothing to resume", next_step="Train without --resume")
        return read_facts(checkpoint)
    if checkpoint.is_file() and not restart:
        raise ConfigError(f"{checkpoint}: an unfinished run is here", next_step="Add --resume, or --restart to drop it")
    return None


def _config(cls: type[C], args: argparse.Namespace, stored: dict[str, Any]) -> C:
    """The configuration of the flags; a resumed run keeps its own, and a flag that differs is an error."""
    values = dict(stored)
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        given = getattr(args, field.name)
        if given is None:
            continue
        if field.name in stored and stored[field.name] != given:
            raise ConfigError(
                f"--{field.name.replace('_', '-')}: the run to resume has another value",
                got=given,
                allowed=stored[field.name],
            )
        values[field.name] = given
    return from_mapping(cls, values, "pred train")


def _add_flag(group: argparse._ArgumentGroup, field: dataclasses.Field[Any], hint: type) -> None:
    unit = field.metadata.get("unit", "")
    text = field.metadata.get("doc", "") + (f" [{unit}]" if unit else "") + f" (default: {field.default})"
    text = text.replace("%", "%%")
    name = "--" + field.name.replace("_", "-")
    if hint is bool:
        group.add_argument(name, dest=field.name, action=argparse.BooleanOptionalAction, default=None, help=text)
    else:
        choices = field.metadata.get("choices") or None
        group.add_argument(name, dest=field.name, type=hint, choices=choices, default=None, help=text)


def _flags(config: TrainingConfig | ResidualConfig) -> list[str]:
    """Every setting as it would be typed, defaults too: they may change, and a resumed run is given none."""
    flags: list[str] = []
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), field.name.replace("_", "-")
        flags += [f"--{name}" if value else f"--no-{name}"] if isinstance(value, bool) else [f"--{name}", str(value)]
    return flags


@contextmanager
def _stop_flag() -> Iterator[list[int]]:
    """A list that SIGINT or SIGTERM fills; a second signal acts as if it had not been caught."""
    stopped: list[int] = []
    previous: dict[signal.Signals, Any] = {}

    def remember(number: int, frame: FrameType | None) -> None:
        stopped.append(number)
        for caught, handler in previous.items():
            signal.signal(caught, handler)

    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, remember)
    try:
        yield stopped
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _tell(line: str) -> None:
    print(f"pred train: {line}", file=sys.stderr, flush=True)

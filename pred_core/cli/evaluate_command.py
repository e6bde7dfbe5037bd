"""`pred evaluate`: models against measured episodes; metrics.json and report.html."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pred_core.bag.dataset import Dataset, load_dataset
from pred_core.cli.checks import warn_of_another_object
from pred_core.errors import ConfigError
from pred_core.evaluate.cache import PredictionCache
from pred_core.evaluate.evaluation import EpisodeStore, Result, run_all
from pred_core.evaluate.models import (
    BASELINES,
    Model,
    NamedTwin,
    baseline_models,
    check_fits,
    shared_calibration,
    twin_models,
)
from pred_core.evaluate.quality import data_quality
from pred_core.evaluate.report import metrics_json, write_json, write_report
from pred_core.evaluate.splits import Split, grouped, published
from pred_core.twin import Twin

NAME = "evaluate"
HELP = "score twins and baselines on measured episodes; writes metrics.json and report.html"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path, help="data set folder")
    parser.add_argument("--twin", action="append", default=[], metavar="[NAME=]TWIN",
                        help="twin directory; without a name it gives spring-mass, extended and pred")
    parser.add_argument("--fold-twins", action="append", default=[], metavar="[NAME=]DIR",
                        help="folder with fold0, fold1, ...: twins fitted without each fold's recordings")
    parser.add_argument("--out", type=Path, required=True, help="output folder; an interrupted run goes on there")
    parser.add_argument("--split", default="test", help="split of the data set to test (train, test, ood)")
    parser.add_argument("--folds", type=int, default=0, metavar="K",
                        help="also test every episode, grouped by recording in K folds (0: no)")
    parser.add_argument("--baselines", nargs="*", default=None, metavar="NAME",
                        help=f"default: all that apply. Known: {', '.join(BASELINES)}")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap")


def run(args: argparse.Namespace) -> int:
    """Exit code 0; raises PredError for bad input."""
    begin = time.monotonic()
    dataset = load_dataset(args.dataset)
    splits: list[Split] = [published(dataset, args.split)]
    if args.folds:
        splits.append(grouped(dataset, args.folds))
    twins = _twins(args.twin, args.fold_twins)
    store = EpisodeStore(dataset, shared_calibration(twins))
    first = store.read(splits[0].folds[0].test[:1])[0]
    for named in twins:
        warn_of_another_object(named.twin, dataset, named.name or str(args.twin[0]))
        for twin in (named.twin, *named.folds):
            check_fits(twin, first, named.name or "TWIN")
    models, optional = _models(twins, args.baselines)
    args.out.mkdir(parents=True, exist_ok=True)
    gate = data_quality(dataset, args.out / "cache")
    progress = _Progress(sum(len(s.folds) for s in splits) * len(models))
    results, missing = run_all(models, optional, splits, store, PredictionCache(args.out / "cache"), progress)
    command = "pred " + shlex.join(["evaluate", *_words(args)])
    numbers = metrics_json(dataset, results, missing, gate, args.seed, command)
    write_json(args.out / "metrics.json", numbers)
    write_report(args.out / "report.html", dataset, results, numbers, twins)
    _print_table(dataset, results, numbers["entries"])
    for m in missing:
        print(f"not computed: {m.model} on {m.split}: {m.reason}")
    print(f"{args.out / 'report.html'}  {args.out / 'metrics.json'}  ({time.monotonic() - begin:.1f} s)")
    return 0


class _Progress:
    """A line for each model and fold on stderr, with the time left at the pace so far."""

    def __init__(self, total: int):
        self.total, self.done, self.begin = total, 0, time.monotonic()

    def __call__(self, what: str) -> None:
        self.done += 1
        elapsed = time.monotonic() - self.begin
        left = elapsed / self.done * max(self.total - self.done, 0)
        print(f"[{self.done}/{self.total}] {what}, {elapsed:.0f} s, about {left:.0f} s left", file=sys.stderr)


def _twins(given: Sequence[str], fold_folders: Sequence[str]) -> list[NamedTwin]:
    folders = dict(_split_name(f) for f in fold_folders)
    twins: list[NamedTwin] = []
    for text in given:
        name, path = _split_name(text)
        if name in [t.name for t in twins]:
            raise ConfigError(f"two twins are called '{name}'" if name else "two twins have no name",
                              next_step="Name the others: --twin NAME=TWIN")
        twins.append(NamedTwin(name, Twin.load(path), _fold_twins(folders.pop(name)) if name in folders else ()))
    if folders:
        raise ConfigError("--fold-twins without a --twin of that name", got=", ".join(folders) or "no name")
    return twins


def _fold_twins(folder: Path) -> tuple[Twin, ...]:
    paths = sorted(folder.glob("fold[0-9]*"), key=lambda p: int(p.name[4:]) if p.name[4:].isdigit() else -1)
    if [p.name for p in paths] != [f"fold{i}" for i in range(len(paths))] or not paths:
        raise ConfigError(f"{folder}: fold twins", got=", ".join(p.name for p in paths) or "none",
                          allowed="fold0, fold1, ... without gaps")
    return tuple(Twin.load(p) for p in paths)


def _split_name(text: str) -> tuple[str, Path]:
    name, separator, path = text.partition("=")
    return (name, Path(path)) if separator else ("", Path(text))


def _models(twins: Sequence[NamedTwin], baselines: Sequence[str] | None) -> tuple[list[Model], frozenset[str]]:
    """All models, and the names of those that may fail to apply (baselines nobody asked for by name)."""
    models = [m for named in twins for m in twin_models(named)]
    wanted = BASELINES if baselines is None else tuple(baselines)
    if baselines is None and not twins:
        wanted = tuple(b for b in wanted if b != "last-residual")
    models += baseline_models(wanted, twins[0] if twins else None)
    names = [m.name for m in models]
    twice = {n for n in names if names.count(n) > 1}
    if twice:
        raise ConfigError("two models have one name", got=", ".join(sorted(twice)), next_step="Use --twin NAME=TWIN")
    if not models:
        raise ConfigError("nothing to evaluate", next_step="Give --twin or --baselines")
    return models, frozenset(wanted if baselines is None else ())


def _words(args: argparse.Namespace) -> list[str]:
    words = [str(args.dataset)]
    for flag, values in (("--twin", args.twin), ("--fold-twins", args.fold_twins)):
        for value in values:
            words += [flag, value]
    words += ["--out", str(args.out), "--split", args.split]
    if args.folds:
        words += ["--folds", str(args.folds)]
    if args.baselines is not None:
        words += ["--baselines", *args.baselines]
    return [*words, "--seed", str(args.seed)]


def _print_table(dataset: Dataset, results: Sequence[Result], entries: Sequence[dict]) -> None:  # type: ignore[type-arg]
    print(f"{dataset.object.name}: coordinate_l1 over all steps [1e-2 m], 95 % interval over episodes")
    for e in entries:
        s = e["metrics"]["coordinate_l1"]["all_steps"]
        if s["mean"] is None:
            value = "no episode left"
        else:
            interval = "" if s["low_95"] is None else f" [{100 * s['low_95']:.2f}, {100 * s['high_95']:.2f}]"
            value = f"{100 * s['mean']:.2f}{interval}  median {100 * s['median']:.2f}  n={s['episodes']}"
        lost = "".join(f"; diverged in {d['episode']} at step {d['step']}" for d in e["diverged"])
        print(f"  {e['split']:32s} {e['model']:20s} {value}{lost}")

"""Does the extension help the network, and the other way round: {base, extended} x {without, with network}.

Both networks get the same steps, seed and settings to choose from; what is chosen is what errs least on train
recordings that were held out of training, the backbone alone included (`pred train` keeps the first weights, which
add nothing, if no step is better). Test episodes choose nothing.

    python benchmarks/network_2x2.py cable dlo2 --out out/cables --folds 3
        base: the paper's five parameters; extended: the twin that ships; the published split, and grouped by recording:
        both identified and both networks trained anew for every fold, with --fold-steps and the settings that were
        chosen on the published split's train episodes
    python benchmarks/network_2x2.py case DATASET --base TWIN --extended DIR/twin --out DIR/network
        a diagnosed data set: its test and ood episodes; DIR/network/network.json is what `pred diagnose --network`
        shows in its report

Each step is a `pred` command, printed as it runs, and is skipped when its result is there. Errors are open loop from
frames 0 and 1; intervals are 95 % over episodes, differences are paired. Prints markdown.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measured_cables import IDENTIFY, SEEDS, TRAIN, fold_data, fold_twins, identify, train
from measured_cables import pred as run_pred

from pred_core.bag.dataset import Dataset, EpisodeEntry, load_dataset
from pred_core.bag.measured import measured_or_explain
from pred_core.cli.main import BAD_INPUT
from pred_core.errors import ConfigError, PredError
from pred_core.evaluate.bootstrap import bootstrap_interval
from pred_core.evaluate.protocol import predict
from pred_core.evaluate.report import write_json
from pred_core.evaluate.scores import over_steps, score_episode
from pred_core.pred import load_dynamics
from pred_core.twin import Twin
from pred_core.types import Array

# Without carrying on: on 30 Hz tracks with millimetres of noise a window starts from data. Wider: a bad base needs it.
ROPE = shlex.split(
    "--no-guard --no-azimuth --rollout 15 --batch 16 --stride 2 --cap 0.3 --penalty 0.01 --average 0.99 "
    "--evaluate-every 100 --arc-frequencies 3 --encoder-layers 2 --feature 32 --embedding 32 --feedforward 64 "
    "--encoder-feedforward 64"
)
TIGHT = [*TRAIN, "--no-guard"]
WIDE = shlex.split("--cap 0.1 --penalty 0.01")
FREE = shlex.split("--cap 0.5 --penalty 0.01")  # 0.1 m/s binds most components on a base that lacks the damping
SETTINGS: dict[str, dict[str, list[str]]] = {
    "cable": {"tight": TIGHT, "wide": [*TIGHT, *WIDE], "free": [*TIGHT, *FREE]},
    "case": {"long": ROPE, "short": [*ROPE, "--rollout", "5", "--learning-rate", "3e-3"]},
}
BACKBONES = ("base", "extended")
NETWORK = " + network"
Errors = dict[str, Array]  # cell -> (E,) [mm], the same episodes in every cell


@dataclass(frozen=True)
class Setup:
    """One data set to train on, and a twin for every backbone."""

    data: Path
    twins: Mapping[str, Path]
    out: Path
    steps: int


def main() -> int:
    """Train what is missing, evaluate, print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="kind", required=True)
    cable = kinds.add_parser("cable")
    cable.add_argument("cable", choices=("dlo1", "dlo2"))
    cable.add_argument("--folds", type=int, default=0, help="also grouped by recording, with as many folds")
    cable.add_argument("--fold-steps", type=int, default=1000, help="training steps of the folds' networks")
    case = kinds.add_parser("case")
    case.add_argument("dataset", type=Path)
    case.add_argument("--base", type=Path, required=True, help="the twin that was questioned")
    case.add_argument("--extended", type=Path, required=True, help="the twin that `pred diagnose` wrote")
    for kind, steps, every in ((cable, 3000, SETTINGS["cable"]), (case, 1500, SETTINGS["case"])):
        kind.add_argument("--out", type=Path, required=True)
        kind.add_argument("--steps", type=int, default=steps, help="training steps of each network")
        kind.add_argument("--settings", nargs="+", choices=every, default=[*every], help="to choose from")
    args = parser.parse_args()
    try:
        return make_tables(args)
    except (PredError, OSError) as error:
        print(f"network_2x2: {error}", file=sys.stderr)
        return BAD_INPUT


def make_tables(args: argparse.Namespace) -> int:
    """The tables that are asked for, printed and written. Raises: PredError."""
    if args.kind == "cable" and args.folds not in (0, *range(2, 71)):
        raise ConfigError("--folds", got=args.folds, allowed="0, or 2 to 70")
    for flag in ("steps", "fold_steps"):
        if getattr(args, flag, 1) < 1:
            raise ConfigError(f"--{flag.replace('_', '-')}", got=getattr(args, flag), allowed="1 or more")
    settings = {name: SETTINGS[args.kind][name] for name in args.settings}
    args.out.mkdir(parents=True, exist_ok=True)
    if args.kind == "case":
        for path in (args.base, args.extended):
            Twin.load(path)  # all of it before hours of training
        load_dataset(args.dataset)
        setup = Setup(args.dataset, {"base": args.base, "extended": args.extended}, args.out, args.steps)
        tables = published(setup, settings, "mde")[0]
    else:
        tables = of_cable(args.cable, args.out / args.cable, settings, args.steps, args.folds, args.fold_steps)
    for split, errors in tables.items():
        print("\n".join(markdown(split, errors)), flush=True)
    out = args.out if args.kind == "case" else args.out / args.cable
    write_json(out / "network.json", {s: {k: summary(v) for k, v in e.items()} for s, e in tables.items()})
    write_json(out / "network_episodes.json", {s: {k: v.tolist() for k, v in e.items()} for s, e in tables.items()})
    return 0


def of_cable(
    cable: str, root: Path, settings: Mapping[str, list[str]], steps: int, folds: int, fold_steps: int
) -> dict[str, Errors]:
    """Published split, and grouped by recording if there are folds."""
    data = root / "data"
    if not (data / "dataset.yaml").exists():
        run_pred("convert", "deform", str(measured_or_explain(f"deform_{cable}.npz")), "--out", str(data))
    for name in ("paper", "chain"):
        identify(data, root / name, IDENTIFY[name])
    identify(data, root / "extended", [*IDENTIFY["extended"], "--base", str(root / "chain")])
    twins = {"base": root / "paper", "extended": root / "extended"}
    tables, chosen = published(Setup(data, twins, root / "network", steps), settings, "coordinate_l1")
    if folds:
        tables["grouped"] = grouped(load_dataset(data), root, folds, fold_steps, chosen)
    return tables


def published(
    setup: Setup, settings: Mapping[str, list[str]], metric: str
) -> tuple[dict[str, Errors], dict[str, str]]:
    """Split -> errors on it, and the setting chosen for every backbone."""
    chosen = {}
    for name in BACKBONES:
        for setting, flags in settings.items():
            train(setup.data, setup.twins[name], trained(setup, name, setting), SEEDS[0], setup.steps, flags)
        chosen[name] = min(settings, key=lambda s: held_out(trained(setup, name, s)))
        said = ", ".join(f"{s} {held_out(trained(setup, name, s)):.3f} mm" for s in settings)
        print(f"{name}: held out of training: {said}; {chosen[name]} is taken", flush=True)
    dataset = load_dataset(setup.data)
    splits = [s for s in ("test", "ood") if s in dataset.splits]
    return {s: errors_of(setup, chosen, dataset, dataset.select(s), metric) for s in splits}, chosen


def grouped(dataset: Dataset, root: Path, folds: int, steps: int, chosen: Mapping[str, str]) -> Errors:
    """Every episode once, by twins and networks that saw no episode of its recording."""
    twins = fold_twins(dataset, root, folds)
    parts: list[Errors] = []
    for number, fold in enumerate(dataset.grouped_folds(folds)):
        data = fold_data(root, number, folds)
        identify(data, twins / f"paper{number}", IDENTIFY["paper"])
        own = {"base": twins / f"paper{number}", "extended": twins / f"fold{number}"}
        setup = Setup(data, own, root / f"network_folds{folds}" / str(number), steps)
        for name in BACKBONES:
            flags = SETTINGS["cable"][chosen[name]]
            train(data, own[name], trained(setup, name, chosen[name]), SEEDS[0], steps, flags)
        parts.append(errors_of(setup, chosen, dataset, fold.test, "coordinate_l1"))
    return {cell: np.concatenate([p[cell] for p in parts]) for cell in parts[0]}


def trained(setup: Setup, backbone: str, setting: str) -> Path:
    """Where a twin with its network stands."""
    return setup.out / f"{backbone}_{setting}"


def held_out(twin: Path) -> float:
    """[mm] open loop on the train recordings that choose the step, of the step that was kept."""
    curves = json.loads((twin / "train.json").read_text(encoding="utf-8"))["curves"]
    return float(min(curves["held_out_mm"]))


def errors_of(
    setup: Setup, chosen: Mapping[str, str], dataset: Dataset, entries: Sequence[EpisodeEntry], metric: str
) -> Errors:
    """The four cells on these episodes; one that diverges in any cell is left out of all, and named."""
    raw: dict[str, dict[str, float]] = {}
    for name in BACKBONES:
        twin = Twin.load(trained(setup, name, chosen[name]))
        episodes = [twin.calibration.correct(dataset.read(e)) for e in entries]
        for cell, residual in ((name, False), (name + NETWORK, True)):
            predictions = predict(load_dynamics(twin, residual=residual), episodes)
            scores = [score_episode(p, e) for p, e in zip(predictions, episodes, strict=True)]
            lost = [s.name for s in scores if s.diverged is not None]
            if lost:
                print(f"{cell}: diverges on {', '.join(lost)}: left out of every cell", flush=True)
            raw[cell] = {s.name: 1e3 * over_steps(s, metric) for s in scores if s.diverged is None}
    names = [n for n in raw["base"] if all(n in values for values in raw.values())]
    return {cell: np.array([values[n] for n in names]) for cell, values in raw.items()}


def markdown(split: str, errors: Errors) -> list[str]:
    """The 2x2 in mm, each with its interval, and the paired differences."""
    number = len(errors["base"])
    lines = ["", f"| {split}, {number} episodes [mm] | without | with network | what the network takes away |"]
    lines.append("|---|---|---|---|")
    for name in BACKBONES:
        plain, both = errors[name], errors[name + NETWORK]
        lines.append(f"| {name} | {shown(plain)} | {shown(both)} | {difference(plain, both)} |")
    without = difference(errors["base"], errors["extended"])
    with_ = difference(errors["base" + NETWORK], errors["extended" + NETWORK])
    lines.append(f"| what the extension takes away | {without} | {with_} | |")
    return lines


def summary(values: Array) -> dict[str, float]:
    """Mean and 95 % over episodes."""
    low, high = bootstrap_interval(values, np.random.default_rng(0))
    return {"mean": float(values.mean()), "low": low, "high": high}


def shown(values: Array) -> str:
    """Mean, 95 % over episodes, median."""
    s = summary(values)
    return f"{s['mean']:.2f} [{s['low']:.2f}, {s['high']:.2f}] / {np.median(values):.2f}"


def difference(before: Array, after: Array) -> str:
    """Mean paired difference, 95 % over episodes, how many improve."""
    gain = before - after
    s = summary(gain)
    return f"{s['mean']:.2f} [{s['low']:.2f}, {s['high']:.2f}], {int((gain > 0).sum())} of {len(gain)}"


if __name__ == "__main__":
    raise SystemExit(main())

"""The numbers of the measured cables: convert, identify, train, evaluate; the twins that ship are its output.

Which flags make which numbers, for each cable (dlo1, dlo2):

    python benchmarks/measured_cables.py dlo2
        published split: paper, drag, spring-mass, extended, pred (seed 0), baselines; the twins that ship
    ... --seeds 3
        and pred with the seeds 1 and 2, as pred-seed1 and pred-seed2
    ... --folds 5
        and grouped by recording: spring-mass and extended, identified anew for every fold, and the baselines that
        refit themselves. pred, paper, drag and the other seeds are listed there as not computed, and last-residual
        is on the extended fold twins
    ... --folds 5 --train-folds
        and grouped by recording: pred, its residual trained anew for every fold (seed 0). Slow: the training time
        of the published split once a fold

Without --folds there is no row grouped by recording; without --train-folds there is none of pred. Fold twins are
refined in two stages and hold nothing out (--stages 1.0,1e9 --hold-out 0), to save time.

Each step is a `pred` command, printed as it runs, and is skipped when its result is there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from pred_core.bag.dataset import Dataset, load_dataset, write_dataset
from pred_core.bag.measured import measured_or_explain
from pred_core.errors import ConfigError, PredError
from pred_core.twin import Twin

EFFECTS = "bending_damping,bending_hysteresis,rest_curvature,bending_profile"
CONTINUOUS = "stiffness,bending_stiffness"  # first neighbours alone: skip springs would bend a second time
IDENTIFY = {
    "paper": ["--paper"],
    "drag": ["--effects", "drag_linear"],
    "chain": ["--effects", "bending_damping", "--parameters", CONTINUOUS],
    "extended": ["--effects", EFFECTS, "--parameters", CONTINUOUS, "--restarts", "1", "--shrink", "3e-6"],
}
TRAIN = shlex.split(
    "--no-azimuth --gradient detached --carry 124 --rollout 4 --loss smooth --beta 0.3 --cap 0.02 --penalty 0.3 "
    "--learning-rate 1e-3 --average 0.995 --outlier 2 --arc-frequencies 3 --encoder-layers 2 --feature 32 "
    "--embedding 32 --feedforward 64 --encoder-feedforward 64"
)
SEEDS = (0, 1, 2)


def main() -> int:
    """Run the steps for one cable; 2 for bad input, in one line."""
    try:
        return run_steps()
    except (PredError, OSError) as error:
        print(f"measured_cables: {error}", file=sys.stderr)
        return 2


def run_steps() -> int:
    """Each step that is not there yet. Raises: PredError."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cable", choices=("dlo1", "dlo2"))
    parser.add_argument("--out", type=Path, default=Path("out/cables"))
    parser.add_argument("--folds", type=int, default=0, help="also identify for every fold of a grouped split")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of the residual network to train")
    parser.add_argument("--steps", type=int, default=3000, help="training steps of the residual network")
    parser.add_argument("--train-folds", action="store_true", help="also train the residual for every fold (slow)")
    args = parser.parse_args()
    if args.train_folds and not args.folds:
        parser.error("--train-folds needs --folds")
    root = args.out / args.cable
    data = root / "data"
    if not (data / "dataset.yaml").exists():
        pred("convert", "deform", str(measured_or_explain(f"deform_{args.cable}.npz")), "--out", str(data))
    for name in ("paper", "drag", "chain"):
        identify(data, root / name, IDENTIFY[name])
    identify(data, root / "extended", [*IDENTIFY["extended"], "--base", str(root / "chain")])
    named = [f"{name}={root / name}" for name in ("paper", "drag")]
    for seed in SEEDS[: args.seeds]:
        train(data, root / "extended", root / f"pred{seed}", seed, args.steps)
        if seed:
            named.append(f"pred-seed{seed}={root / f'pred{seed}'}")
    flags = [part for name in [str(root / "pred0"), *named] for part in ("--twin", name)]
    if args.folds:
        dataset = load_dataset(data)
        twins = fold_twins(dataset, root, args.folds)
        if args.train_folds:
            twins = trained_fold_twins(root, twins, args.folds, args.steps)
        flags += ["--folds", str(args.folds), "--fold-twins", str(twins)]
    pred("evaluate", str(data), *flags, "--out", str(root / "evaluation"))
    return 0


def fold_twins(dataset: Dataset, root: Path, folds: int) -> Path:
    """One extended twin for every fold, identified without the fold's recordings."""
    twins = root / f"folds{folds}"
    for number, fold in enumerate(dataset.grouped_folds(folds)):
        part = fold_data(root, number, folds)
        if not (part / "dataset.yaml").exists():
            part.mkdir(parents=True, exist_ok=True)
            for entry in fold.train:
                link = part / entry.bag
                if not link.exists():
                    os.link(dataset.root / entry.bag, link)
            entries = [dataclasses.replace(e, split="train") for e in fold.train]
            write_dataset(
                part, object=dataset.object, rate=dataset.rate, entries=entries, gravity=dataset.gravity,
                sigma=dataset.sigma, held=dataset.held, known=dataset.known,
            )  # fmt: skip
        chain = twins / f"chain{number}"
        identify(part, chain, IDENTIFY["chain"])
        flags = [*IDENTIFY["extended"], "--stages", "1.0,1e9", "--hold-out", "0", "--base", str(chain)]
        identify(part, twins / f"fold{number}", flags)
    return twins


def trained_fold_twins(root: Path, twins: Path, folds: int, steps: int) -> Path:
    """The twins of `fold_twins` with a residual, each trained without the fold's recordings too."""
    trained = root / f"pred_folds{folds}"
    for number in range(folds):
        train(fold_data(root, number, folds), twins / f"fold{number}", trained / f"fold{number}", SEEDS[0], steps)
    return trained


def fold_data(root: Path, number: int, folds: int) -> Path:
    """The data set that a fold's twin may see."""
    return root / f"data_fold{number}of{folds}"


def identify(data: Path, twin: Path, flags: list[str]) -> None:
    """`pred identify`, unless the twin is there."""
    if not (twin / "twin.yaml").exists():
        pred("identify", str(data), "--out", str(twin), *flags)


def train(data: Path, twin: Path, out: Path, seed: int, steps: int, flags: Sequence[str] = TRAIN) -> None:
    """`pred train`, resumed where it stopped, unless the weights are there.

    Raises: ConfigError if what is there was asked otherwise: other steps, seed, flags, data or twin. What was trained
    before that was written down is taken as it is, and said.
    """
    begun = [n for n in ("residual.safetensors", "train.checkpoint.safetensors") if (out / n).exists()]
    dataset = load_dataset(data)
    asked = {"data": [dataset.sha256(e) for e in dataset.entries], "twin": Twin.load(twin).digest(),
             "seed": seed, "steps": steps, "flags": list(flags)}  # fmt: skip
    beside = out.parent / f"{out.name}.asked.json"
    if begun and not beside.exists():
        print(f"{out}: was trained before; with what settings is not known", flush=True)
    elif begun:
        before = json.loads(beside.read_text(encoding="utf-8"))
        other = [k if k in ("data", "twin") else f"{k} {before.get(k)}, now {v}" for k, v in asked.items()
                 if before.get(k) != v]  # fmt: skip
        if other:
            raise ConfigError(f"{out} was trained otherwise", got="; ".join(other), next_step="Give another --out")
    else:
        out.parent.mkdir(parents=True, exist_ok=True)
        part = beside.with_suffix(".part")
        part.write_text(json.dumps(asked) + "\n", encoding="utf-8")
        part.replace(beside)
    if not (out / "residual.safetensors").exists():
        resume = ["--resume"] if (out / "train.checkpoint.safetensors").exists() else []
        settings = [] if resume else [*flags, "--steps", str(steps), "--seed", str(seed)]
        pred("train", str(data), "--twin", str(twin), "--out", str(out), *resume, *settings)


def pred(*arguments: str) -> None:
    """Run one `pred` command and stop if it fails."""
    print("pred " + shlex.join(arguments), flush=True)
    code = subprocess.run([sys.executable, "-m", "pred_core.cli.main", *arguments], check=False).returncode
    if code:
        sys.exit(code)


if __name__ == "__main__":
    sys.exit(main())

"""Hide effects in another engine's world, diagnose every case, and score the names.

    python benchmarks/hidden_effects.py run --work out/hidden --jobs 2
        draw the final cases, simulate them, identify one twin per reference, diagnose; goes on where it stopped
    python benchmarks/hidden_effects.py score --work out/hidden
        the table in markdown, and scores.json in the work folder
    ... paired --work out/hidden
        the base's error on the same motions with nothing hidden: how strong an effect is; `score` bins by it
    ... oracle --work out/hidden          ... baselines --work out/hidden
        what could be avoided at most, and what simpler ways would have answered: `score` then shows them too
    ... ablate --work out/hidden
        the diagnoses that are there again, each without one step (in WORK/out_no_<step>): `score` then compares them
    ... run --placebos    ... score --placebos
        six laws that nothing obeys among the candidates; answers in WORK/out_placebos
    ... --set dev
        the development cases, on which everything was chosen; other seeds, other folder
    ... --set seen
        cases that an earlier version of the engine answered and that were looked at: development cases as well

A case's data stand in WORK/<name>, its truth beside it, its diagnosis in WORK/out/<name>. Everything is kept that is
there already.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

from hidden_bench import pieces
from hidden_cases import SETS, Case, Release, release, simulate
from hidden_scores import Judgement, judged
from hidden_table import ablated, compare, markdown, scores
from hidden_work import ANSWER, CODE, TWIN, check_data, check_truth, code_of, diagnosed, read_json, twin_of

import pred_core
from pred_core.cli.main import BAD_INPUT
from pred_core.diagnose.config import STEPS
from pred_core.errors import ConfigError, PredError

IDENTIFY = shlex.split(
    "--parameters stiffness,damping,ground_friction,bending_stiffness --effects bending_damping --restarts 2"
)
PRED = ("-m", "pred_core.cli.main")
HERE = Path(__file__).parent
ONE_THREAD = {"OMP_NUM_THREADS": "1"}


def main() -> int:
    """Run one of the commands."""
    args = _arguments()
    try:
        if getattr(args, "jobs", 1) < 1:
            raise ConfigError("--jobs", got=args.jobs, allowed="1 or more")
        return int(args.act(args))
    except PredError as error:
        print(f"hidden_effects: {error}", file=sys.stderr)
        return BAD_INPUT


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="simulate, identify and diagnose")
    run.set_defaults(act=run_cases)
    run.add_argument("--flags", default="", help="more flags for pred diagnose, in one string")
    less = commands.add_parser("ablate", help="diagnose again, each time without one step")
    less.set_defaults(act=run_ablations)
    score = commands.add_parser("score", help="score the diagnoses that are there")
    score.set_defaults(act=score_cases)
    least = commands.add_parser("oracle", help="fit the true law of every case that has one")
    least.set_defaults(act=run_oracle)
    simple = commands.add_parser("baselines", help="answers of simpler ways")
    simple.set_defaults(act=run_baselines)
    alike = commands.add_parser("flips", help="what sign flips of recordings and of episodes say of the controls")
    alike.set_defaults(act=run_flips)
    plain = commands.add_parser("paired", help="errors of the base on the same motions with nothing hidden")
    plain.set_defaults(act=run_paired)
    for command in (run, less, least, simple, plain):
        command.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at once")
    for command in (run, score):
        command.add_argument("--placebos", action="store_true", help="with laws that nothing obeys")
    for command in (run, less, score, least, simple, plain, alike):
        command.add_argument("--only", nargs="*", default=[], metavar="NAME", help="only these cases")
        command.add_argument("--work", type=Path, required=True, metavar="DIR", help="where everything stands")
        command.add_argument("--out", default="", help="folder of the answers in the work folder (out)")
        command.add_argument("--set", choices=SETS, default="final", help="which cases")
    args = parser.parse_args()
    args.out = args.out or ("out_placebos" if getattr(args, "placebos", False) else "out")
    return args


def chosen(drawn: Release, only: Sequence[str]) -> list[Case]:
    """The cases that are asked for."""
    known = {c.name: c for c in drawn.cases}
    missing = [n for n in only if n not in known]
    if missing:
        allowed = f"{drawn.cases[0].name} to {drawn.cases[-1].name}"
        raise ConfigError("--only", got=", ".join(missing), allowed=allowed, next_step="Or name another --set")
    return [known[n] for n in only] if only else list(drawn.cases)


def run_cases(args: argparse.Namespace) -> int:
    """What is missing: references and their twins, then cases. Returns 1 if something failed."""
    drawn = release(args.set)
    cases = chosen(drawn, args.only)
    try:
        args.work.mkdir(parents=True, exist_ok=True)
        (args.work / ".writable").touch()
        (args.work / ".writable").unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError("--work", got=f"{args.work}: {error.strerror}", allowed="a folder to write in") from error
    references = {c.reference for c in cases}
    failed = _all(
        "twin", sorted(r for r in references if not (twin_of(args.work, r) / TWIN).exists()), args.jobs,
        partial(_identify, args.work, drawn.references),
    )  # fmt: skip
    missing_cases = {c.name: c for c in cases if not (args.work / args.out / c.name / ANSWER).exists()}
    print(f"{len(cases) - len(missing_cases)} of {len(cases)} cases are there", flush=True)
    ready = [n for n, c in missing_cases.items() if c.reference not in failed]
    failed += _all("case", ready, args.jobs, partial(_diagnose, args, missing_cases))
    return 1 if failed or len(ready) < len(missing_cases) else 0


def run_ablations(args: argparse.Namespace) -> int:
    """The cases that were diagnosed, without each step in turn. Returns 1 if something failed."""
    cases = diagnosed(args.work, args.out, chosen(release(args.set), args.only))
    check_data(args.work, cases)
    only = [c.name for c in cases]
    failed = 0
    for step in STEPS:
        print(f"without {step}", flush=True)
        flags = f"--no-{step.replace('_', '-')}"
        less = argparse.Namespace(
            **{**vars(args), "only": only, "out": without(step), "flags": flags, "placebos": False}
        )
        failed |= run_cases(less)
    return failed


def without(step: str) -> str:
    """Folder of the answers without a step."""
    return f"out_no_{step}"


def _identify(work: Path, seeds: Mapping[str, int], name: str) -> int:
    simulate(work / name, (), seeds[name])
    twin = twin_of(work, name)
    return _pred(["identify", str(work / name), "--out", str(twin), *IDENTIFY], twin.parent / f"{name}.log")


def _diagnose(args: argparse.Namespace, cases: Mapping[str, Case], name: str) -> int:
    case, work, out = cases[name], args.work, args.work / args.out / name
    simulate(work / case.name, case.hidden, case.seed, case.extent)
    out.mkdir(parents=True, exist_ok=True)
    (out / CODE).write_text(_code() + "\n", encoding="utf-8")
    program = [str(HERE / "hidden_placebos.py")] if args.placebos else PRED
    words = ["diagnose", str(work / case.name), "--twin", str(twin_of(work, case.reference)), "--reference",
             str(work / case.reference), "--out", str(out), *shlex.split(args.flags)]  # fmt: skip
    return _pred(words, work / args.out / f"{case.name}.log", program)


def _code() -> str:
    """A hash of the code that diagnoses: answers of different code must not be mixed unseen."""
    digest = hashlib.sha256()
    root = Path(pred_core.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _pred(words: Sequence[str], log: Path, program: Sequence[str] = PRED) -> int:
    """Exit code of one `pred` command on one thread, its words in a log. It runs the code that `_code` hashes."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w", encoding="utf-8") as stream:
        stream.write("pred " + shlex.join(words) + "\n")
        stream.flush()
        return subprocess.run(
            [sys.executable, *program, *words], stdout=stream, stderr=subprocess.STDOUT,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(Path(pred_core.__file__).parents[1])}, check=False,
        ).returncode  # fmt: skip


def _all(what: str, names: Sequence[str], jobs: int, do: Callable[[str], int]) -> list[str]:
    """Do it for every name, `jobs` at once, with an estimate of the time left. Returns the names that failed."""
    begin = time.monotonic()
    failed = []
    with ProcessPoolExecutor(jobs) as pool:
        running = {pool.submit(do, name): name for name in names}
        for done, future in enumerate(as_completed(running), start=1):
            name = running[future]
            try:
                code = future.result()
            except PredError as error:
                print(f"{what} {name}: {error}", flush=True)
                code = BAD_INPUT
            if code:
                failed.append(name)
            passed = time.monotonic() - begin
            left = passed / done * (len(names) - done)
            said = f"failed with code {code}, see its log" if code else "done"
            print(f"{what} {done}/{len(names)} {name} {said}; {passed / 60:.1f} min, {left / 60:.0f} to go", flush=True)
    return failed


def run_oracle(args: argparse.Namespace) -> int:
    """Oracles that are missing. Returns 1 if one failed."""
    from hidden_oracle import has_oracle

    return _beside(args, [c for c in chosen(release(args.set), args.only) if has_oracle(c)])


def run_baselines(args: argparse.Namespace) -> int:
    """Baselines that are missing. Returns 1 if one failed."""
    return _beside(args, chosen(release(args.set), args.only))


def run_paired(args: argparse.Namespace) -> int:
    """Errors without the effects that are missing. Returns 1 if one failed."""
    return _beside(args, [c for c in chosen(release(args.set), args.only) if c.hidden])


def run_flips(args: argparse.Namespace) -> int:
    """Print, for every control, the smallest p value of its first round, and how alike gains of a recording are."""
    from hidden_flips import flips

    controls = [c for c in chosen(release(args.set), args.only) if not c.hidden]
    done = diagnosed(args.work, args.out, controls)
    check_data(args.work, done)
    print("\n".join(flips([(args.work / c.name, args.work / args.out / c.name) for c in done])))
    return 0


def _beside(args: argparse.Namespace, cases: Sequence[Case]) -> int:
    """What the command makes of every case that has been diagnosed, as WORK/<command>/<name>.json."""
    os.environ.update(ONE_THREAD)
    what = args.command
    done = diagnosed(args.work, args.out, cases)
    missing_cases = {c.name: c for c in done if not (args.work / what / f"{c.name}.json").exists()}
    check_data(args.work, list(missing_cases.values()))
    return 1 if _all(what, list(missing_cases), args.jobs, partial(_one_beside, args, missing_cases)) else 0


def _one_beside(args: argparse.Namespace, cases: Mapping[str, Case], name: str) -> int:
    import torch

    torch.set_num_threads(1)
    case, work = cases[name], args.work
    make = getattr(importlib.import_module(f"hidden_{args.command}"), args.command)
    result = make(case, work, twin_of(work, case.reference), work / args.out / name)
    path = work / args.command / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    part.replace(path)
    return 0


def score_cases(args: argparse.Namespace) -> int:
    """The table of what has been diagnosed."""
    simple: dict[str, list[Judgement]] = {}
    cases = chosen(release(args.set), args.only)
    done = diagnosed(args.work, args.out, cases)
    missing = [c.name for c in cases if c not in done]
    codes = {code_of(args.work, args.out, c) for c in done}
    for case in done:
        check_truth(args.work, case)
    rows = [_judged(args.work, args.out, case) for case in done]
    for case in done:
        paired = read_json(args.work / "paired" / f"{case.name}.json")
        for method, answer in (read_json(args.work / "baselines" / f"{case.name}.json") or {}).items():
            simple.setdefault(method, []).append(
                judged(case.name, case.reference, case.hidden, answer, {}, None, paired)
            )
    result = scores(rows, placebos=args.placebos)
    if simple:
        result["baselines"] = compare({"diagnosis": rows, **simple})
    answered = {step: [c for c in cases if (args.work / without(step) / c.name / ANSWER).exists()] for step in STEPS}
    less = {step: [_judged(args.work, without(step), c) for c in found] for step, found in answered.items() if found}
    if less:
        codes |= {code_of(args.work, without(step), c) for step, found in answered.items() for c in found}
        result["ablations"] = ablated(rows, less)
    print(markdown(result))
    print(f"\n{len(rows)} cases scored, {len(missing)} without an answer{': ' + ', '.join(missing) if missing else ''};"
          f" answers of {len(codes)} version{'s' * (len(codes) > 1)} of the code")  # fmt: skip
    (args.work / args.out / "scores.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


def _judged(work: Path, out: str, case: Case) -> Judgement:
    """What an answer that is there is worth."""
    answer = work / out / case.name
    said = read_json(answer / ANSWER)
    beside = {what: read_json(work / what / f"{case.name}.json") for what in ("oracle", "paired")}
    try:
        return judged(case.name, case.reference, case.hidden, said, base=_base(answer), **beside)
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ConfigError(
            f"{case.name}: its answer, oracle or paired error is not whole", got=f"{type(error).__name__}: {error}",
            allowed="files as `run`, `oracle` and `paired` write them", next_step="Remove them and make them again",
        ) from error  # fmt: skip


def _base(answer: Path) -> dict[str, float]:
    """Values of the commissioned twin that some magnitudes are relative to, from the journal."""
    standing = pieces(answer).get("base", {"extensions": []})["extensions"]
    return {name: float(values[0]) for effect in standing for name, values in effect.items()}


if __name__ == "__main__":
    sys.exit(main())

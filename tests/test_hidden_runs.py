"""Commands of the benchmark of hidden effects: nothing twice, nothing in a wrong folder, failures are said."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from bench_modules import loaded_modules
from hidden_answers import MODULES, answer


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    yield from loaded_modules(MODULES)


def test_runs_go_on_and_say_what_failed(
    bench: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two cases, one already diagnosed, the other fails: nothing is done twice and the exit code says so."""
    effects = bench["hidden_effects"]
    drawn = bench["hidden_cases"].release("final")
    calls = tmp_path / "calls"

    def pred(words: Sequence[str], log: Path, program: Sequence[str] = ()) -> int:
        with calls.open("a") as stream:
            stream.write(f"{words[0]} {Path(words[1]).name}\n")
        if words[0] == "identify":
            twin = Path(words[words.index("--out") + 1])
            twin.mkdir(parents=True)
            (twin / "twin.yaml").touch()
        return 0 if words[0] == "identify" else 2

    monkeypatch.setattr(effects, "_pred", pred)
    monkeypatch.setattr(effects, "simulate", lambda *_: None)
    first, second = (c.name for c in drawn.cases[:2])
    done = tmp_path / "out" / first
    done.mkdir(parents=True)
    (done / "diagnosis.json").write_text("{}")
    words = ["x", "run", "--work", str(tmp_path), "--jobs", "1", "--only", first, second]
    monkeypatch.setattr(sys, "argv", words)
    assert effects.main() == 1
    assert effects.main() == 1
    said = capsys.readouterr().out
    assert f"{second} failed with code 2" in said and "1 of 2 cases are there" in said
    twins = [f"identify {c.reference}" for c in drawn.cases[:2]]
    assert calls.read_text().splitlines() == [*twins, *[f"diagnose {second}"] * 2]


def test_scores_are_written_and_foreign_truths_refused(
    bench: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = next(c for c in bench["hidden_cases"].release("final").cases if not c.hidden)
    out = tmp_path / "out" / case.name
    out.mkdir(parents=True)
    (out / "diagnosis.json").write_text(json.dumps(answer("none", ranking=[("none", 0.9)])))
    truth = tmp_path / f"{case.name}.truth.json"
    truth.write_text(json.dumps({"hidden": [], "seed": case.seed}))
    monkeypatch.setattr(sys, "argv", ["x", "score", "--work", str(tmp_path), "--only", case.name])
    assert bench["hidden_effects"].main() == 0
    assert "0/1 = 0 % [0.0 to 97.5]" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / "scores.json").read_text())["confusion"] == {"none": {"none": 1}}
    whole = (out / "diagnosis.json").read_text()
    (out / "diagnosis.json").write_text("{}")
    assert bench["hidden_effects"].main() == 2
    assert f"{case.name}: its answer, oracle or paired error is not whole" in capsys.readouterr().err
    (out / "diagnosis.json").write_text(whole)
    truth.write_text(json.dumps({"hidden": [], "seed": case.seed + 1}))
    assert bench["hidden_effects"].main() == 2
    assert "is of another case" in capsys.readouterr().err
    for text, told in (("{", "is not whole"), ("[]", "holds no mapping")):
        truth.write_text(text)
        assert bench["hidden_effects"].main() == 2
        assert told in capsys.readouterr().err


def left_by_a_run(work: Path, cases: Sequence[Any]) -> None:
    """Empty files where a run leaves data, twins and answers of these cases."""
    for case in cases:
        for name in (f"{case.name}/dataset.yaml", f"{case.reference}/dataset.yaml",
                     f"twins/{case.reference}/twin.yaml", f"out/{case.name}/diagnosis.json"):  # fmt: skip
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            (work / name).touch()


@pytest.mark.parametrize("command", ["ablate", "paired", "baselines", "oracle", "flips", "score"])
def test_what_reads_a_run_begins_nothing_where_none_has_finished(
    bench: dict[str, ModuleType], command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """A mistyped --work, one without answers, and one whose twin or truth is gone: one line, and nothing is made."""

    def forbidden(*_: object) -> int:
        raise AssertionError("something was begun")

    for name in ("_all", "simulate"):
        monkeypatch.setattr(bench["hidden_effects"], name, forbidden)
    cases = bench["hidden_cases"].release("final").cases
    mistyped, empty, half = tmp_path / "wrok", tmp_path / "empty", tmp_path / "half"
    (empty / "out").mkdir(parents=True)
    left_by_a_run(half, cases)
    for reference in {c.reference for c in cases}:
        (half / "twins" / reference / "twin.yaml").unlink()
    before = sorted(tmp_path.rglob("*"))
    gone = "truth.json" if command == "score" else "twin.yaml"
    for work, told in ((mistyped, "no folder"), (empty, "without an answer of these cases"), (half, gone)):
        monkeypatch.setattr(sys, "argv", ["x", command, "--work", str(work)])
        assert bench["hidden_effects"].main() == 2
        said = capsys.readouterr()
        assert told in said.err and str(work) in said.err and "`run`" in said.err and not said.out
        assert said.err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_each_step_is_left_out_in_turn_and_compared_on_the_same_cases(
    bench: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two controls. With all steps both are none; without cross-fitting the one that it answered is a false alarm."""
    effects = bench["hidden_effects"]
    controls = [c for c in bench["hidden_cases"].release("final").cases if not c.hidden][:2]
    calls = []

    def pred(words: Sequence[str], log: Path, program: Sequence[str] = ()) -> int:
        calls.append(words)
        return 0

    monkeypatch.setattr(effects, "_pred", pred)
    monkeypatch.setattr(effects, "_all", lambda what, names, jobs, do: [n for n in names if do(n)])
    monkeypatch.setattr(effects, "simulate", lambda *_: None)
    one = controls[0].name
    left_by_a_run(tmp_path, controls[:1])
    monkeypatch.setattr(sys, "argv", ["x", "ablate", "--work", str(tmp_path), "--only", *(c.name for c in controls)])
    assert effects.main() == 0
    diagnosed = [words for words in calls if words[0] == "diagnose"]
    steps = ("settle", "back_fit", "cross_fit", "chaos_weights")
    assert [Path(w[w.index("--out") + 1]).parent.name for w in diagnosed] == [f"out_no_{s}" for s in steps]
    assert [w[-1] for w in diagnosed] == ["--no-settle", "--no-back-fit", "--no-cross-fit", "--no-chaos-weights"]
    named = answer("named", ("drag_linear", {"coefficient": (1.0, 0.5, 1.5)}), ranking=[("drag_linear", 0.9)])
    none = answer("none", ranking=[("none", 0.9)])
    for case in controls:
        (tmp_path / f"{case.name}.truth.json").write_text(json.dumps({"hidden": [], "seed": case.seed}))
    for out, name, said in (("out", one, none), ("out", controls[1].name, none), ("out_no_cross_fit", one, named)):
        (tmp_path / out / name).mkdir(parents=True, exist_ok=True)
        (tmp_path / out / name / "diagnosis.json").write_text(json.dumps(said))
    monkeypatch.setattr(sys, "argv", ["x", "score", "--work", str(tmp_path), "--only", *(c.name for c in controls)])
    assert effects.main() == 0
    shown = capsys.readouterr().out.splitlines()
    row = next(n for n, line in enumerate(shown) if line.startswith("|") and "without cross_fit" in line)
    assert "without settle" not in shown[row]
    assert "0/1 = 0 %" in shown[row + 2] and "1/1 = 100 %" in shown[row + 2]  # controls: anything but none

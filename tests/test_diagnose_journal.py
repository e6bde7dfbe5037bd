"""A journal belongs to its data and settings, and what no diagnosis wrote is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnose_cases import SMALL, SPLITS, quiet
from report_cases import recorded, rope

from pred_core.diagnose.commission import commission, values_of, with_stored
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import judge, quick, screen
from pred_core.diagnose.structure import COMPANION, applies, chain, question
from pred_core.diagnose.structure import _with as with_effects
from pred_core.effects import find_effect
from pred_core.errors import ConfigError, TwinError
from pred_core.twin import Twin
from pred_core.types import Episode

# A piece of two episodes as version 3 of the journal had it, without `excited`.
TWO = {"z": [1.0], "null": [0.0], "left_out": [[1.0]], "gain": [1.0] * 2, "moved": [1.0] * 2, "extended": [1.0] * 2}


@pytest.fixture(scope="module")
def twin() -> Twin:
    return rope()


@pytest.fixture(scope="module")
def reference(twin: Twin) -> list[Episode]:
    return recorded(twin, (), SPLITS, seed=100, frames=40)


def test_a_journal_belongs_to_its_data(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    assert Journal(path, {"data": "a"}).once("x", lambda: [1.0]) == [1.0]
    assert Journal(path, {"data": "a"}).once("x", lambda: [2.0]) == [1.0]
    other = Journal(path, {"data": "b"})
    assert other.once("x", lambda: [3.0]) == [3.0]
    assert '"a"' in (tmp_path / "journal.old1.jsonl").read_text()
    assert '"a"' not in path.read_text()


def test_no_journal_that_was_put_aside_is_lost(tmp_path: Path) -> None:
    """The next number that is free, and whoever asked is told where it went and what it was of."""
    path, told = tmp_path / "journal.jsonl", []
    (tmp_path / "journal.old2.jsonl").write_text("mine")
    for name in "abc":
        Journal(path, {"data": name}, lambda *where: told.append(where)).once("x", lambda: 1)
    assert told == [(tmp_path / "journal.old1.jsonl", {"data": "a"}), (tmp_path / "journal.old3.jsonl", {"data": "b"})]
    for aside, header in told:
        assert json.loads(aside.read_text().splitlines()[0]) == {"header": header}
    assert (tmp_path / "journal.old2.jsonl").read_text() == "mine"


@pytest.mark.parametrize("line", ["a diary", "[1]", '{"header": 3}', "{}"])
def test_a_file_that_is_no_journal_is_put_aside(tmp_path: Path, line: str) -> None:
    path, told = tmp_path / "journal.jsonl", []
    path.write_text(line + "\n")
    Journal(path, {"data": "a"}, lambda *where: told.append(where)).once("x", lambda: 1)
    assert told == [(tmp_path / "journal.old1.jsonl", None)] and told[0][0].read_text() == line + "\n"


def test_nothing_is_written_before_a_piece_is_finished(tmp_path: Path) -> None:
    """Data that do not fit the twin are told of after the journal was opened: another diagnosis' journal stays."""
    path = tmp_path / "journal.jsonl"
    Journal(path, {"data": "a"})
    assert not path.exists()
    Journal(path, {"data": "a"}).once("x", lambda: 1)
    before = path.read_text()
    Journal(path, {"data": "b"})
    assert path.read_text() == before and not list(tmp_path.glob("journal.old*"))


def test_a_line_that_was_cut_off_is_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    first = Journal(path, {})
    first.once("x", lambda: 1)
    whole = path.read_text()
    first.once("y", lambda: 2)
    path.write_text(path.read_text()[:-5])
    again = Journal(path, {})
    assert again.once("x", lambda: 3) == 1 and again.once("y", lambda: 4) == 4
    assert path.read_text() == whole + '{"key": "y", "value": 4}\n'


@pytest.mark.parametrize("line", ["not a line", '{"key": "x"}', "[1, 2]", "3"])
def test_a_damaged_journal_is_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "journal.jsonl"
    Journal(path, {}).once("x", lambda: 1)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(ConfigError, match=r"journal\.jsonl: is damaged.*Delete it") as refused:
        Journal(path, {})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [("base", 3), ("base", {"physics": {"stiffness": "soft"}, "extensions": []}),
     ("base", {"physics": {"stiffness": 20.0}, "extensions": []}), ("x/screen", []),
     ("x/screen", [[[0.1, 0.2], 1.0]]), ("x/quick", [[None], 1.0]), ("x/fit", {"z": [1.0]}),
     ("x/fit", {"z": [1.0], "null": [0.0], "left_out": [[1.0]], "gain": [1.0], "moved": [1.0], "extended": [1.0]}),
     ("x/fit", TWO), ("x/fit", {**TWO, "excited": "many"})],
)  # fmt: skip
def test_a_value_that_no_diagnosis_wrote_is_refused(
    twin: Twin, reference: list[Episode], tmp_path: Path, key: str, value: Any
) -> None:
    """The line is whole, what it says is not: text for a number, nothing, a coordinate too many, an episode too few."""
    path = tmp_path / "journal.jsonl"
    Journal(path, {}).once("base", lambda: values_of(twin))
    lines = [line for line in path.read_text().splitlines() if f'"{key}"' not in line]
    path.write_text("\n".join([*lines, json.dumps({"key": key, "value": value})]) + "\n")
    journal = Journal(path, {})
    said = f"journal.jsonl: the value of '{key}' is damaged.*Delete the file"
    with pytest.raises(ConfigError, match=said) as refused:
        bench = commission(twin, reference[:2], reference[2:4], SMALL, quiet, journal)
        found = screen(bench, (find_effect("drag_linear"),), np.random.default_rng(0), journal, "x/screen")
        quick(bench, found, journal, "x/quick")
        judge(bench, found, journal, "x/fit")
    assert "\n" not in str(refused.value)


def test_values_that_no_parameter_may_have_are_refused(twin: Twin) -> None:
    """Whole and finite, but a negative stiffness, or a drag beyond what the effect declares: with the range."""
    extended = twin.replace(extensions=(find_effect("drag_linear").extension(coefficient=1.0),))
    good = values_of(extended)
    assert with_stored(twin.replace(extensions=extended.extensions), good).physics == twin.physics
    with pytest.raises(ConfigError, match="physics: stiffness; got -20"):
        with_stored(extended, {**good, "physics": {**good["physics"], "stiffness": -20.0}})
    with pytest.raises(TwinError, match="'drag_linear': 'coefficient'; got -1"):
        with_stored(extended, {**good, "extensions": [{"coefficient": [-1.0]}]})


@pytest.mark.parametrize("key", ["structure", "structure/damped"])
@pytest.mark.parametrize("value", ["empty", "a recording too few", "softer than nothing", "a list"])
def test_a_damaged_answer_about_bending_is_refused(
    twin: Twin, reference: list[Episode], tmp_path: Path, key: str, value: str
) -> None:
    """The chain as it is saves nothing here, so that the chain with damping is asked for too."""
    path = tmp_path / "journal.jsonl"
    bench = commission(twin, reference[:3], (), SMALL, quiet, Journal(None, {}))
    assert applies(bench.twin)
    pieces = {}
    for name, effects in (("structure", ()), ("structure/damped", (COMPANION,))):
        whole = values_of(with_effects(chain(bench.twin), effects))
        pieces[name] = {"twin": whole, "without": [[int(g), whole] for g in bench.fitted.roller.sample.groups]}
    whole = pieces[key]["twin"]
    soft = {**whole, "physics": {**whole["physics"], "bending_stiffness": -1.0}}
    pieces[key] = {
        "empty": {"twin": {}, "without": []},
        "a recording too few": {**pieces[key], "without": pieces[key]["without"][1:]},
        "softer than nothing": {**pieces[key], "twin": soft},
        "a list": [],
    }[value]
    first = Journal(path, {})
    for name, piece in pieces.items():
        first.once(name, lambda piece=piece: piece)
    with pytest.raises(ConfigError, match=f"journal.jsonl: the value of '{key}' is damaged.*Delete") as refused:
        question(bench, Journal(path, {}), quiet)
    assert "\n" not in str(refused.value)

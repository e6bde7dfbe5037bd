"""What `pred identify` says of its errors, and in which order it lets go of what it has."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import pytest
from evaluation_cases import swinging_cable

from pred_core.bag.dataset import EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.cli import identify_command, train_command
from pred_core.cli.main import main
from pred_core.identify.report import write_report
from pred_core.identify.run import Identified
from pred_core.springmass.topology import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import ObjectInfo, Physics


@pytest.fixture(scope="module")
def found() -> Identified:
    """A result made by hand: 1.5 mm fitted, 2.5 mm held out."""
    physics = Physics(stiffness=200.0)
    body = build_body("line", swinging_cable(0).position[0], 0.05, physics)
    entry = {"value": 200.0, "unit": "N", "at_bound": False, "identifiable": True, "sensitivity": 0.1}
    return Identified(
        twin=Twin(TwinMeta(object=ObjectInfo("cable", "line")), body, physics), values={"stiffness": entry},
        restarts=[{"seed": 0, "loss_mm": 1.0, "evaluations": 10, "stiffness": 200.0}], fitted_mm=1.5, held_out_mm=2.5,
        windows={"ep000": 1.5}, left_out=(), noise_mm=0.1, seconds=1.0, seed=0,
    )  # fmt: skip


def command(tmp_path: Path) -> list[str]:
    write_episode(tmp_path / "data" / "ep000.mcap", swinging_cable(0, split="train"))
    entries = [EpisodeEntry("ep000.mcap", "train", 0)]
    write_dataset(tmp_path / "data", object=ObjectInfo("cable", "line"), rate=100.0, entries=entries)
    return ["identify", str(tmp_path / "data"), "--out", str(tmp_path / "twin")]


@pytest.fixture
def identified(found: Identified, monkeypatch: pytest.MonkeyPatch) -> Identified:
    """What the command finds at once, leaving its journal."""

    def identify(dataset: object, episodes: object, config: object, journal: Path, *rest: object) -> Identified:
        journal.parent.mkdir(exist_ok=True)
        journal.write_text("{}")
        return found

    monkeypatch.setattr(identify_command, "identify", identify)
    return found


def test_the_held_out_error_is_said_to_be_of_the_parameters_before_the_last_refit(
    identified: Identified, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(tmp_path)) == 0
    printed = capsys.readouterr().out
    assert "best 90 % of windows" in printed
    assert "2.50 mm on recordings held out, before the last refit" in printed
    stored = json.loads((tmp_path / "twin" / "identify.json").read_text())
    assert stored["error_mm"]["held_out"] == 2.5
    assert "before the last refit" in stored["definitions"]["error_mm.held_out"]
    assert "before the last refit" in (tmp_path / "twin" / "identify.html").read_text()
    assert not (tmp_path / "twin" / identify_command.JOURNAL).exists()
    write_report(tmp_path / "none.html", dataclasses.replace(identified, held_out_mm=None), "pred identify")
    assert "held out" not in (tmp_path / "none.html").read_text()


@pytest.mark.usefixtures("identified")
def test_the_journal_stays_until_everything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(identify_command, "write_report", interrupted)
    assert main(command(tmp_path)) == 130
    assert (tmp_path / "twin" / identify_command.JOURNAL).is_file()
    assert "the search goes on where it stopped, the refinement starts again" in capsys.readouterr().err


def test_other_commands_say_what_they_do_after_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(args: argparse.Namespace) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(train_command, "run", interrupted)
    assert main(["train", "data", "--twin", "twin"]) == 130
    assert "--resume" in capsys.readouterr().err

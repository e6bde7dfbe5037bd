"""What several commands say about inputs that do not fit together, and about places that cannot be written."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from pred_core.bag.dataset import load_dataset
from pred_core.cli.checks import warn_of_another_object
from pred_core.cli.main import BAD_INPUT, main
from pred_core.twin import Twin
from pred_core.types import ObjectInfo

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "bags/sample_cable"
SHIPPED = ("deform_dlo1", "deform_dlo2")


def test_a_twin_of_another_object_is_pointed_out(capsys: pytest.CaptureFixture[str]) -> None:
    dataset = load_dataset(SAMPLE)
    twin = Twin.load(ROOT / "config/twins/deform_dlo2")
    warn_of_another_object(twin, dataset, "mine")
    assert "'mine' is of object 'deform_dlo2'" in capsys.readouterr().err
    meta = dataclasses.replace(twin.meta, object=ObjectInfo(dataset.object.name, "line"))
    warn_of_another_object(twin.replace(meta=meta), dataset, "mine")
    assert capsys.readouterr().err == ""


def test_an_output_that_cannot_be_made_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.write_text("not a folder")
    assert main(["identify", str(SAMPLE), "--out", str(file)]) == BAD_INPUT
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pred: ")]
    assert len(lines) == 1 and str(file) in lines[0]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_twins_load_with_base_residual_and_what_is_held(name: str) -> None:
    twin = Twin.load(ROOT / "config/twins" / name)
    count = twin.body.count
    assert twin.meta.held == ((0, 0), (1, 1), (count - 2, 2), (count - 1, 3))
    assert twin.residual is not None and twin.base is not None and twin.base.residual is None
    assert {e.id for e in twin.extensions} > {e.id for e in twin.base.extensions}
    assert not any(c.startswith("/") for c in twin.meta.created_by.split())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["diagnose", "data", "--twin", "t", "--out", "o", "--secnods", "3"], "'--secnods'. did you mean '--seconds'?"),
        (["diagnose", "data", "--twni", "t"], "'--twni'. did you mean '--twin'?"),  # though --out is missing
        (["evaluate", "data", "--twni=t", "--out", "o"], "'--twni'. did you mean '--twin'?"),
        (["plant", "rope", "--efect", "gust"], "'--efect'. did you mean '--effect'?"),
    ],
)
def test_an_option_that_no_command_has(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert capsys.readouterr().err.strip() == f"pred: unknown option {said}"


@pytest.mark.parametrize("words", [["--no-settle"], ["--sec", "3"], ["--seconds=3"]])
def test_an_option_that_there_is_passes(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Switched off, cut short, or with its value: the next thing that is wrong is told."""
    assert main(["diagnose", str(tmp_path / "none"), "--twin", "t", "--out", "o", *words]) == 2
    assert "not a data set" in capsys.readouterr().err

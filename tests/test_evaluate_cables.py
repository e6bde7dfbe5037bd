"""The benchmark of the measured cables: what is trained for a fold sees only that fold's data."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "measured_cables.py"


@pytest.fixture
def script() -> ModuleType:
    """The script as a module of its own."""
    spec = importlib.util.spec_from_file_location("measured_cables", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_residual_of_a_fold_is_trained_on_its_twin_and_its_data(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[tuple[str, ...]] = []
    monkeypatch.setattr(script, "pred", lambda *words: commands.append(words))
    done = tmp_path / "pred_folds3" / "fold1" / "residual.safetensors"
    done.parent.mkdir(parents=True)
    done.touch()
    assert script.trained_fold_twins(tmp_path, tmp_path / "folds3", 3, 10) == tmp_path / "pred_folds3"
    made = [(c[1], c[c.index("--twin") + 1], c[c.index("--out") + 1], c[c.index("--steps") + 1]) for c in commands]
    assert made == [
        (f"{tmp_path}/data_fold{i}of3", f"{tmp_path}/folds3/fold{i}", f"{tmp_path}/pred_folds3/fold{i}", "10")
        for i in (0, 2)
    ], "the fold that is there is not trained again"


def test_training_for_folds_needs_folds(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), "dlo1", "--train-folds"])
    with pytest.raises(SystemExit, match="2"):
        script.main()
    assert "--train-folds needs --folds" in capsys.readouterr().err

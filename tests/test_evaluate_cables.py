"""The benchmark of the measured cables: what is trained for a fold sees only that fold's data."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from pred_core.errors import ConfigError

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
    plain(script, monkeypatch)
    done = tmp_path / "pred_folds3" / "fold1" / "residual.safetensors"
    done.parent.mkdir(parents=True)
    done.touch()
    assert script.trained_fold_twins(tmp_path, tmp_path / "folds3", 3, 10) == tmp_path / "pred_folds3"
    made = [(c[1], c[c.index("--twin") + 1], c[c.index("--out") + 1], c[c.index("--steps") + 1]) for c in commands]
    assert made == [
        (f"{tmp_path}/data_fold{i}of3", f"{tmp_path}/folds3/fold{i}", f"{tmp_path}/pred_folds3/fold{i}", "10")
        for i in (0, 2)
    ], "the fold that is there is not trained again"


def plain(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Data sets and twins that need not be there."""
    monkeypatch.setattr(script, "load_dataset", lambda path: SimpleNamespace(entries=[], sha256=str))
    twin = SimpleNamespace(digest=lambda: "twin")
    monkeypatch.setattr(script, "Twin", SimpleNamespace(load=lambda path: twin))


def test_what_was_trained_otherwise_is_not_gone_on_with(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps that were asked in vain leave nothing behind; a checkpoint of other steps is refused by name."""
    commands: list[tuple[str, ...]] = []
    monkeypatch.setattr(script, "pred", lambda *words: commands.append(words))
    plain(script, monkeypatch)
    out = tmp_path / "out"
    script.train(tmp_path, tmp_path, out, 0, -5)
    script.train(tmp_path, tmp_path, out, 0, 100)  # nothing was begun before
    assert len(commands) == 2
    out.mkdir()
    (out / "train.checkpoint.safetensors").touch()
    script.train(tmp_path, tmp_path, out, 0, 100)
    assert commands[-1][-1] == "--resume"
    with pytest.raises(ConfigError, match="was trained otherwise; got steps 100, now 200"):
        script.train(tmp_path, tmp_path, out, 0, 200)
    assert len(commands) == 3


def test_training_for_folds_needs_folds(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), "dlo1", "--train-folds"])
    with pytest.raises(SystemExit, match="2"):
        script.main()
    assert "--train-folds needs --folds" in capsys.readouterr().err

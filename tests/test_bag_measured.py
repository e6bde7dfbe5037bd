"""Measured data: PRED_DATA, then data/, then ../shared/data."""

from pathlib import Path

import pytest

from pred_core.bag import measured
from pred_core.errors import ConfigError, DatasetError


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for folder in ("chosen", "repo/data", "shared/data"):
        (tmp_path / folder).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "repo")
    monkeypatch.setattr(measured, "_REPOSITORY", tmp_path / "repo")
    monkeypatch.delenv("PRED_DATA", raising=False)
    return tmp_path


def test_the_order_of_places(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert measured.find_measured("cable") is None
    (places / "shared/data/cable.npz").touch()
    assert measured.find_measured("cable") == places / "shared/data/cable.npz"
    (places / "repo/data/cable.npz").touch()
    assert measured.find_measured("cable.npz") == places / "repo/data/cable.npz"
    monkeypatch.setenv("PRED_DATA", str(places / "chosen"))
    assert measured.find_measured("cable") == places / "repo/data/cable.npz"  # not in the chosen folder
    (places / "chosen/cable.npz").touch()
    assert measured.find_measured("cable") == places / "chosen/cable.npz"


def test_nothing_found_says_where_and_what_to_do(places: Path) -> None:
    with pytest.raises(DatasetError, match="no measured data 'cable' found; got nothing in .*repo/data.*PRED_DATA"):
        measured.measured_or_explain("cable")


def test_a_wrong_pred_data_is_not_passed_over(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRED_DATA", str(places / "typo"))
    with pytest.raises(ConfigError, match="PRED_DATA names no folder"):
        measured.find_measured("cable")

"""`pred convert` and `pred info` from the command line."""

import json
from pathlib import Path

import pytest
from bag_examples import line_bag, points_edited
from test_bag_deform import _npz

from pred_core.cli.main import main


def test_convert_then_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    npz, out = str(_npz(tmp_path / "deform_x.npz")), str(tmp_path / "out")
    assert main(["convert", "deform", npz, "--out", out]) == 0
    printed = capsys.readouterr()
    assert "4 episodes (3 train, 1 test) of 2 recordings" in printed.out
    assert "4/4 ep003.mcap, about 0 s left" in printed.err
    assert main(["info", out]) == 0
    text = capsys.readouterr().out
    assert "deform_x (line), 100 Hz" in text and "ready for pred identify" in text
    assert "1 recordings have episodes in train and in test: this split leaks" in text
    assert main(["info", out, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["splits"] == {"train": 3, "test": 1} and facts["recordings"] == 2 and facts["shared_recordings"] == [1]
    assert [e["name"] for e in facts["episodes"]] == ["ep000", "ep001", "ep002", "ep003"]


@pytest.mark.parametrize("form", ["deform", "beam"])
def test_a_measured_file_is_found_by_its_name(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PRED_DATA", str(_npz(tmp_path / "deform_x.npz").parent))
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    if form == "deform":
        assert main(["convert", form, "deform_x.npz", "--out", "out"]) == 0
        assert (tmp_path / "empty/out/dataset.yaml").exists()
    else:  # found, and refused for what is in it
        assert main(["convert", form, "deform_x.npz", "--out", "out"]) == 2
        assert "no takes of a beam" in capsys.readouterr().err
    assert main(["convert", form, "deform_y.npz", "--out", "no"]) == 2
    said = capsys.readouterr().err
    assert "no measured data 'deform_y.npz' found" in said and "Set PRED_DATA" in said


def test_info_of_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(line_bag(tmp_path / "a.mcap")), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    points = next(t for t in facts["topics"] if t["topic"] == "tracker/points")
    assert points["count"] == 20 and points["rate"] == pytest.approx(100.0) and points["clock"] == "header"
    assert (facts["particles"], facts["grippers"], facts["hidden"], facts["problems"]) == (5, 2, 0.0, [])
    assert facts["low"] == pytest.approx([0.0, 0.0, 0.5]) and facts["high"] == pytest.approx([0.4, 0.19, 0.5])


def test_info_reports_a_truncated_bag_as_far_as_it_goes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = line_bag(tmp_path / "a.mcap", frames=400)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert main(["info", str(path)]) == 1
    text = capsys.readouterr().out
    assert "not ready for pred identify" in text and "truncated or damaged" in text and "5 particles" in text


def test_info_lists_every_bad_message_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def spoil(cloud):
        cloud["id"][3] = 10

    assert main(["info", str(points_edited(tmp_path / "a.mcap", spoil))]) == 1
    assert capsys.readouterr().out.count("duplicate ids 10") == 1


def test_info_goes_on_past_a_broken_bag_of_a_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["convert", "deform", str(_npz(tmp_path / "x.npz")), "--out", str(tmp_path / "out")])
    (tmp_path / "out" / "ep001.mcap").write_bytes(b"broken")
    capsys.readouterr()
    assert main(["info", str(tmp_path / "out")]) == 1
    text = capsys.readouterr().out
    assert "ep001.mcap: not a bag" in text and "ep003" in text


@pytest.mark.parametrize(
    "command",
    [
        ["info", "nowhere.mcap"],
        ["convert", "deform", "nowhere.npz", "--out", "out"],
        ["convert", "deform", ".", "--out", "out"],
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(command) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()

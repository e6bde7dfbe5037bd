"""What `pred diagnose` reads is not written over, and what contradicts itself is refused, each in one line."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from diagnose_runs import SPLITS, diagnose, refusal, write
from report_cases import drag, recorded, rope

from pred_core.cli.main import main
from pred_core.diagnose.out_folder import check_out
from pred_core.types import Episode, Scene


@pytest.fixture(scope="module")
def dragged() -> list[Episode]:
    return recorded(rope(), drag(), SPLITS, seed=0, frames=40)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, dragged: list[Episode]) -> Path:
    """`twin`, `suspect` with a drag of 1.5 /s, `reference` without."""
    root = tmp_path_factory.mktemp("diagnose")
    rope().save(root / "twin")
    write(root / "suspect", dragged)
    write(root / "reference", recorded(rope(), (), SPLITS, seed=100, frames=40))
    return root


def tree(root: Path) -> dict[str, bytes]:
    """Every file under a folder."""
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("inside", ["twin", "deep/mine", "link"])
def test_out_must_not_hold_the_questioned_twin(
    inside: str, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The answer's twin is written to OUT/twin: over the one that is questioned, also through a link."""
    out = tmp_path / "out"
    if inside == "link":
        rope().save(tmp_path / "mine")
        out.mkdir()
        (out / "twin").symlink_to(tmp_path / "mine")
        twin = tmp_path / "mine"
    else:
        twin = out / inside
        rope().save(twin)
    before = tree(tmp_path)
    assert diagnose(world / "suspect", twin, out, "--reference", str(world / "reference")) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "--out holds the twin that is questioned" in line and f"--twin {twin}" in line
    assert line.endswith("Give another --out.") and tree(tmp_path) == before


def test_out_must_not_hold_a_twin_of_others(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that `pred identify` wrote there, with nothing of a diagnosis beside it."""
    rope().save(tmp_path / "twin")
    before = tree(tmp_path)
    assert diagnose(world / "suspect", world / "twin", tmp_path) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "a twin that no diagnosis wrote" in line and "move that twin away" in line and tree(tmp_path) == before


@pytest.mark.parametrize("name", ["report.html", "diagnosis.json", "next_motion.yaml", "journal.jsonl"])
def test_out_must_not_hold_results_of_others(
    name: str, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The report of `pred evaluate`, somebody's diagnosis.json or a diary stay; beside them an answer is refused."""
    (tmp_path / "report.html").write_text("<h1>Evaluation</h1>")
    (tmp_path / name).write_text('{"a": 1}\n')
    before = tree(tmp_path)
    assert diagnose(world / "suspect", world / "twin", tmp_path) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "report.html" in line and "that no diagnosis wrote there" in line and tree(tmp_path) == before
    assert line.endswith("Give another --out, or move it away.")


@pytest.mark.parametrize("ours", ["diagnosis.json", "journal.jsonl", "journal.old1.jsonl"])
def test_what_a_diagnosis_left_is_taken_for_its_own(ours: str, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("<h1>Diagnosis</h1>")
    rope().save(tmp_path / "twin")
    text = {"outcome": "none", "sentence": "", "causes": []} if ours == "diagnosis.json" else {"header": {"data": []}}
    (tmp_path / ours).write_text(json.dumps(text) + "\n")
    check_out(tmp_path, tmp_path.parent / "elsewhere", {})


@pytest.mark.parametrize("flags", [(), ("--guard",)])
@pytest.mark.parametrize("deep", [False, True])
def test_out_must_be_a_folder(
    flags: tuple[str, ...], deep: bool, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    out = tmp_path / "file" / "deeper" if deep else tmp_path / "file"
    arguments = ["diagnose", str(world / "suspect"), "--twin", str(world / "twin"), "--out", str(out), *flags]
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "--out must be a folder" in line and f"got {tmp_path / 'file'}, which is a file" in line
    assert (tmp_path / "file").read_text() == "mine"


def test_one_recording_must_not_be_fitted_and_held_out(
    world: Path, tmp_path: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """The same bag under another name, as train and as test; in the reference too."""
    data = write(tmp_path / "data", [*dragged[:5], dataclasses.replace(dragged[5], name="other")])
    shutil.copy(data / "ep1.mcap", data / "other.mcap")
    line = refusal(capsys, data, world / "twin", tmp_path / "out")
    assert f"{data}: one recording is listed twice; got ep1.mcap (train) and other.mcap (test)" in line
    assert line.endswith("Remove one of them from dataset.yaml.")
    against = ("--reference", str(data))
    assert "listed twice" in refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", *against)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1]", "got list, not a mapping"),
        ('{"test": 3}', "got split 'test' without 'base'"),
        ('{"test": {"base": {"mean": 1.0, "low": 0.5}}}', "got 'base' of split 'test' without 'high'"),
        ('{"test": {"base": {"mean": null, "low": 0.5, "high": 2}}}', "got None as 'mean' of 'base' of split 'test'"),
        ("{", "cannot be read"),
    ],
)
def test_a_network_file_that_is_none(
    text: str, said: str, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line in words: what is missing, and what makes such a file."""
    (tmp_path / "n.json").write_text(text)
    line = refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", "--network", str(tmp_path / "n.json"))
    assert said in line and line.endswith("Make it with benchmarks/network_2x2.py.") and "Error" not in line


@pytest.mark.parametrize(
    ("which", "said"),
    [("data", "of the data set"), ("reference", "of the reference"), ("twin", "of the twin"),
     ("data/dataset.yaml", "of the data set")],
)  # fmt: skip
def test_out_must_not_be_an_input(
    which: str, said: str, world: Path, tmp_path: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "data", dragged[:2])
    shutil.copytree(world / "reference", tmp_path / "reference")
    rope().save(tmp_path / "twin")
    before = tree(tmp_path)
    folder, _, file = which.partition("/")
    data = tmp_path / "data" / file  # a data set may be given by its dataset.yaml
    out = tmp_path / "data" / ".." / folder
    assert diagnose(data, tmp_path / "twin", out, "--reference", str(tmp_path / "reference")) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"--out is the folder {said}" in line and line.endswith("Give another --out.") and tree(tmp_path) == before


def test_a_data_set_where_the_answers_twin_goes(
    tmp_path: Path, world: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "twin", dragged[:2])
    before = tree(tmp_path)
    assert diagnose(tmp_path / "twin", world / "twin", tmp_path) == 2
    assert "would be written into the data set" in capsys.readouterr().err and tree(tmp_path) == before


def test_a_reference_with_bags_of_the_data_set(
    world: Path, tmp_path: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """The data set itself shows no change; nor does one that holds some of its recordings, under whatever name."""
    itself = ("--reference", str(world / "suspect"))
    line = refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", *itself)
    assert "got 6 of 6 bags in both: ep0.mcap, ep1.mcap, ep2.mcap, ep3.mcap, ep4.mcap and 1 more" in line
    assert "Give another --reference, or leave it out" in line
    old = recorded(rope(), (), SPLITS, seed=100, frames=40)
    mixed = write(tmp_path / "mixed", [*old[:4], dataclasses.replace(old[4], name="again"), old[5]])
    shutil.copy(world / "suspect" / "ep2.mcap", mixed / "again.mcap")
    line = refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", "--reference", str(mixed))
    assert "got 1 of 6 bags in both: ep2.mcap (there again.mcap);" in line


def test_a_gravity_that_contradicts(
    world: Path, tmp_path: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """1 % of 9.81 m/s^2 is allowed, as vectors: 9.80 or a tilt of half a degree pass, of a degree (0.17) do not."""
    up, out = write(tmp_path / "up", dragged[:2], gravity=(0.0, 0.0, 9.81)), tmp_path / "out"
    line = refusal(capsys, up, world / "twin", out)
    assert f"[0, 0, 9.81] m/s^2 in dataset.yaml, [0, 0, -9.81] m/s^2 in {world / 'twin' / 'twin.yaml'}" in line
    assert "Correct 'gravity' in dataset.yaml, or identify the twin on this data: pred identify" in line
    line = refusal(capsys, world / "suspect", world / "twin", out, "--reference", str(up))
    assert line.startswith(f"pred: reference {up}: its gravity contradicts the data set's") and "[0, 0, 9.81]" in line
    line = refusal(capsys, up, world / "twin", out, "--reference", str(world / "reference"))
    assert "the twin's" in line
    line = refusal(capsys, write(tmp_path / "lean", dragged[:2], gravity=(0.1712, 0.0, -9.8085)), world / "twin", out)
    assert "[0.1712, 0, -9.8085]" in line
    rope().replace(scene=Scene(gravity=(0.08, 0.0, -9.80))).save(tmp_path / "twin")  # 0.081 apart
    still = [dataclasses.replace(e, split="ood") for e in dragged[:2]]  # the next thing that is wrong is told
    assert "'train'" in refusal(capsys, write(tmp_path / "near", still), tmp_path / "twin", out)


# Another world of springs, in which the twin can be right -------------------------------------------------------------

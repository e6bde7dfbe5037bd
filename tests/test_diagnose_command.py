"""`pred diagnose`: what it writes, what it says of few episodes, and one clear line for bad input."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from diagnose_runs import SPLITS, diagnose, matched, read, refusal, write
from report_cases import PERIOD, drag, recorded, rope

from pred_core.diagnose.journal import Journal
from pred_core.pred import load_dynamics
from pred_core.springmass import build_body
from pred_core.twin import Twin
from pred_core.types import Episode, State


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


@pytest.fixture(scope="module")
def found(world: Path) -> Path:
    """Where the answer about the dragged rope is."""
    assert diagnose(world / "suspect", world / "twin", world / "out", "--reference", str(world / "reference")) == 0
    return world / "out"


def test_the_answer_has_what_the_design_says(found: Path) -> None:
    d = read(found)
    assert d["outcome"] == "named" and isinstance(d["sentence"], str)
    (cause,) = d["causes"]
    assert cause["id"] == "drag_linear" and cause["family"] == "drag" and 0.5 < cause["probability"] <= 1.0
    value = cause["parameters"]["coefficient"]
    assert value["unit"] == "1/s" and value["at_bound"] is False
    assert value["value"] == pytest.approx(1.5, rel=0.02) and value["low"] < value["value"] < value["high"]
    assert isinstance(d["group"], list) and isinstance(d["not_identifiable"], list)
    assert all(isinstance(r["id"], str) and 0.0 <= r["probability"] <= 1.0 for r in d["ranking"])
    assert sum(r["probability"] for r in d["ranking"]) == pytest.approx(1.0, abs=0.02)
    error = d["error_mm"]
    assert error["split"] == "test" and error["extended"] < 0.2 * error["base"] and error["floor"] > 0.0
    assert error["base"] == pytest.approx(np.mean([e[0] for e in error["episodes"].values()]))
    assert d["error_mm_ood"] == {}
    gain = d["gain"]
    assert gain["mean_mm"] == pytest.approx(error["base"] - error["extended"])
    assert gain["low_mm"] is None and gain["high_mm"] is None  # one test episode
    assert gain["episodes_improved"] == "1/1" and 0.0 < gain["p_adjusted"] <= 1.0
    budget = d["budget"]
    assert set(budget) == {"named", "learned", "unexplained", "floor"} and budget["learned"] == 0.0
    parts = sum(budget["named"].values()) + budget["learned"] + budget["unexplained"] + budget["floor"]
    assert parts == pytest.approx(error["base"])  # it adds up
    assert {"friction_scale", "friction_viscous", "friction_patch", "table_tilt"} <= set(d["not_testable"]), "it hangs"
    assert not {"drag_linear", "drag_quadratic", "wind", "tip_mass"} & set(d["not_testable"])
    assert d["seconds"] > 0.0 and d["seed"] == 0


def test_few_episodes_are_labelled_exploratory(found: Path) -> None:
    """Six of the ten that a name that holds needs."""
    d = read(found)
    assert d["exploratory"] is True and d["sentence"].startswith("Exploratory")
    assert "drag" in d["sentence"] and "1 of 1 episodes" in d["sentence"]
    shown = float(re.search(r"drag: ([\d.]+) 1/s", d["sentence"])[1])  # type: ignore[index]
    assert shown == pytest.approx(d["causes"][0]["parameters"]["coefficient"]["value"], rel=0.01)


def test_one_train_episode_is_exploratory(world: Path, tmp_path: Path, dragged: list[Episode]) -> None:
    """It is fitted on one motion and judged on two others, and says how little that is."""
    three = [dataclasses.replace(e, split="train" if n == 0 else "test") for n, e in enumerate(dragged[:3])]
    data = write(tmp_path / "data", three)
    assert diagnose(data, world / "twin", tmp_path / "out", "--reference", str(world / "reference")) == 0
    d = read(tmp_path / "out")
    assert d["exploratory"] is True and d["sentence"].startswith("Exploratory")
    assert any("exploratory" in note for note in d["notes"])
    assert d["causes"]
    for cause in d["causes"]:  # one recording has no scatter
        assert all(v["low"] is None and v["high"] is None for v in cause["parameters"].values())


def test_the_extended_twin_is_a_twin(found: Path, world: Path, dragged: list[Episode]) -> None:
    """It runs as it is, slower through the air than its base, and tells why it carries what it carries."""
    twin = Twin.load(found / "twin")
    (extension,) = twin.extensions
    assert extension.id == "drag_linear" and twin.meta.parent == Twin.load(world / "twin").digest()
    assert twin.base is not None and not twin.base.extensions
    assert "diagnose" in twin.meta.created_by
    evidence = extension.evidence
    assert evidence["found_by"] == "pred diagnose" and evidence["episodes_improved"] == "6/6"
    assert 0.0 < evidence["p_adjusted"] < 0.05 and evidence["closed"] == pytest.approx(1.0, abs=0.1)
    low, high = evidence["interval"]["drag_linear.coefficient[0]"]
    assert low < 1.5 < high
    e = dragged[0]
    moving = torch.zeros(10, 3)
    moving[1:, 0] = 1.0  # [m/s]
    state = State(torch.as_tensor(e.position[0]).float(), moving, torch.as_tensor(e.held))
    tips = []
    for dynamics in (load_dynamics(twin), load_dynamics(twin, extensions=False)):
        after = dynamics.step(dynamics.start(state, e.grips.at(0)), e.grips.at(1))
        assert torch.isfinite(after.position).all() and dynamics.period == pytest.approx(PERIOD)
        tips.append(float(after.position[-1, 0]))
    assert 0.0 < tips[0] < tips[1]  # 1.5 /s over 1/30 s: 2.5 % less of 33 mm


def test_run_again_it_says_the_same_at_once(found: Path, world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same job says nothing of what it replaces. What was said of a network goes: this twin has none."""
    before, pieces = read(found), (found / "journal.jsonl").read_text()
    for name in ("guard.json", "guard.html"):
        (found / name).write_text("of an earlier twin's network")
    capsys.readouterr()
    assert diagnose(world / "suspect", world / "twin", found, "--reference", str(world / "reference")) == 0
    again = read(found)
    assert (found / "journal.jsonl").read_text() == pieces  # nothing was computed anew
    assert not list(found.glob("guard.*")) and not list(found.glob("journal.old*"))
    said = capsys.readouterr().err
    assert "put aside" not in said and "replaced" not in said
    assert {k: v for k, v in again.items() if k != "seconds"} == {k: v for k, v in before.items() if k != "seconds"}


def stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Diagnoses that are interrupted after their first piece."""

    def first_piece(*_: object, journal: Journal, **__: object) -> None:
        journal.once("base", lambda: 1)
        raise KeyboardInterrupt

    monkeypatch.setattr("pred_core.cli.diagnose_command.diagnose", first_piece)


def test_another_job_in_the_folder_says_what_becomes_of_the_earlier_ones(
    found: Path, world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each interrupted run keeps its pieces under a number of its own; one line on stderr: where, why, what else."""
    out, against = tmp_path / "out", ("--reference", str(world / "reference"))
    shutil.copytree(found, out)
    pieces = [(out / "journal.jsonl").read_text()]
    stopped(monkeypatch)
    other = matched()  # of another object altogether
    other.save(tmp_path / "other")
    jobs: list[tuple[Path, Path, tuple[str, ...], str]] = [
        (world / "suspect", world / "twin", (*against, "--seed", "1"), "(seed 0, now 1)"),
        (world / "suspect", world / "twin", (*against, "--level", "0.01"), "(level 0.05, now 0.01; seed 1, now 0)"),
        (world / "suspect", world / "twin", (), "(with a reference, now without; level 0.01, now 0.05)"),
        (world / "suspect", tmp_path / "other", (), "(another twin)"),
        (world / "reference", tmp_path / "other", (), "(other bags in the data set)"),
    ]
    for number, (data, twin, flags, why) in enumerate(jobs, start=1):
        capsys.readouterr()
        assert diagnose(data, twin, out, *flags) == 130
        (line,) = (t for t in capsys.readouterr().err.splitlines() if "put aside" in t)
        assert why in line and str(out / f"journal.old{number}.jsonl") in line
        assert "its diagnosis.json, report.html, twin will be replaced" in line.replace("next_motion.yaml, ", "")
        assert [(out / f"journal.old{n + 1}.jsonl").read_text() for n in range(number)] == pieces
        pieces.append((out / "journal.jsonl").read_text())
        capsys.readouterr()
        assert diagnose(data, twin, out, *flags) == 130  # the same job goes on
        assert "put aside" not in capsys.readouterr().err and (out / "journal.jsonl").read_text() == pieces[-1]
    assert read(out) == read(found)


def test_an_answer_without_its_journal_is_told_of(
    found: Path, world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether it is of the same job cannot be known then: a damaged journal was deleted, say, as its error tells to."""
    out = tmp_path / "out"
    shutil.copytree(found, out)
    (out / "journal.jsonl").unlink()
    stopped(monkeypatch)
    assert diagnose(world / "suspect", world / "twin", out) == 130
    (line,) = (t for t in capsys.readouterr().err.splitlines() if "replaced" in t)
    assert f"{out} holds diagnosis.json" in line and "without its journal.jsonl" in line


def test_a_gripper_that_stands_still_tests_nothing(world: Path, tmp_path: Path) -> None:
    """Not testable, rather than absent: a delay of a gripper that rests cannot show."""
    still = write(tmp_path / "still", recorded(rope(), (), SPLITS, seed=5, frames=30, size=0.0))
    assert diagnose(still, world / "twin", tmp_path / "out", "--reference", str(world / "reference")) == 0
    d = read(tmp_path / "out")
    assert {"delay", "camera_scale"} <= set(d["not_testable"])
    assert {"bending_region", "friction_scale", "friction_patch", "table_height"} <= set(d["not_testable"])
    assert "wind" not in d["not_testable"], "a rope that hangs still moves in the wind"
    assert not d["causes"], d["sentence"]
    assert any("stands still" in line for line in d["not_identifiable"])
    assert not any(c["kind"] == "measurement" for c in d["causes"])


# Bad input ------------------------------------------------------------------------------------------------------------


def test_a_missing_twin_or_data_set(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "not a twin" in refusal(capsys, world / "suspect", tmp_path / "none", tmp_path / "out")
    assert str(tmp_path / "none") in refusal(capsys, tmp_path / "none", world / "twin", tmp_path / "out")
    gone = ("--reference", str(tmp_path / "none"))
    assert str(tmp_path / "none") in refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", *gone)


def other_rope(count: int, edge: float) -> Twin:
    """Another object under the same name."""
    rest = np.zeros((count, 3))
    rest[:, 2] = -edge * np.arange(count)
    physics = dataclasses.replace(rope().physics, connection_threshold=1.5 * edge)
    return rope().replace(body=build_body("line", rest, 0.05, physics), physics=physics)


def test_a_twin_of_another_object(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """More particles than are tracked; four times as long: 0.2 m too far a particle, below the half metre it counts."""
    against = ("--reference", str(world / "reference"))
    other_rope(14, 0.05).save(tmp_path / "more")
    line = refusal(capsys, world / "suspect", tmp_path / "more", tmp_path / "out", *against)
    assert "no id 10, 11, 12, 13" in line and "Identify a twin" in line
    other_rope(10, 0.2).save(tmp_path / "longer")
    line = refusal(capsys, world / "suspect", tmp_path / "longer", tmp_path / "out", *against)
    assert "diverges or is not of this object" in line and "Identify a twin" in line


def test_a_wrong_twin_is_no_base(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In its scene the rope lies on a table that is not there; refined on the reference it must explain half of the
    motion."""
    twin = rope()
    twin.replace(scene=dataclasses.replace(twin.scene, ground=0.65)).save(tmp_path / "other")
    against = ("--reference", str(world / "reference"))
    line = refusal(capsys, world / "suspect", tmp_path / "other", tmp_path / "out", *against)
    assert "does not describe the reference" in line and "Identify a twin anew" in line
    assert re.search(r"got \d+ mm of error where the object moves by \d+ mm; allowed: at most 50%", line)


def test_a_twin_a_thousand_times_too_stiff_is_refined_and_said_to_be_off(world: Path, tmp_path: Path) -> None:
    """It rings so wildly that perturbed starts excuse every residual. Its stiffness is found, and then the drag."""
    twin = rope()
    stiff = twin.replace(physics=dataclasses.replace(twin.physics, stiffness=1000.0 * twin.physics.stiffness))
    stiff.save(tmp_path / "stiff")
    out = tmp_path / "out"
    assert diagnose(world / "suspect", tmp_path / "stiff", out, "--reference", str(world / "reference")) == 0
    d = read(out)
    stiffness = d["base"]["parameters"]["stiffness"]
    assert stiffness["given"] == 2e4 and stiffness["refined"] == pytest.approx(20.0, rel=0.05)
    assert "stiffness 2e+04 to" in d["sentence"]
    (cause,) = d["causes"]
    assert cause["id"] == "drag_linear"
    assert cause["parameters"]["coefficient"]["value"] == pytest.approx(1.5, rel=0.05)


def test_a_good_twin_explains_the_motion(found: Path) -> None:
    """With the drag in it: noise and chaos are a few per cent of what the rope moves in a second."""
    assert read(found)["motion_explained"] > 0.9


def test_an_absurd_stiffness(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    twin = rope()
    twin.replace(physics=dataclasses.replace(twin.physics, stiffness=1e9)).save(tmp_path / "twin")
    line = refusal(capsys, world / "suspect", tmp_path / "twin", tmp_path / "out")
    assert "physics.yaml: stiffness" in line and "allowed" in line


def test_no_train_episode(
    world: Path, tmp_path: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    data = write(tmp_path / "data", [dataclasses.replace(e, split="test") for e in dragged])
    assert "'train'" in refusal(capsys, data, world / "twin", tmp_path / "out")


@pytest.mark.parametrize(
    ("flag", "value", "said"),
    [("--level", "7", "level; got 7.0; allowed: 0.0001 to 0.5"), ("--seed", "1.5", "seed"),
     ("--places", "many", "places; got 'many'"), ("--window", "-1", "window; got -1")],
)  # fmt: skip
def test_a_flag_with_a_bad_value(
    flag: str, value: str, said: str, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", flag, value)


def test_a_particle_that_is_never_measured(
    world: Path, tmp_path: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """In one episode of six, or in the reference: told by its id before anything is computed. Seen in one frame it is
    never known with its velocity, which is told with the number of frames.
    """

    def without(e: Episode, ids: list[int], frames: slice) -> Episode:
        position, seen = e.position.copy(), e.tracks.visible.copy()
        for i in ids:
            position[frames, i], seen[frames, i] = np.nan, False
        tracks = dataclasses.replace(e.tracks, position=position, visible=seen, confidence=seen.astype(np.float32))
        return dataclasses.replace(e, tracks=tracks)

    e = dragged[2]
    never = write(tmp_path / "never", [*dragged[:2], without(e, [5, 7], slice(None)), *dragged[3:]])
    line = refusal(capsys, never, world / "twin", tmp_path / "out")
    assert f"{e.name}: particles of the twin are never measured" in line and "got id 5, 7;" in line
    assert "leave the episode out" in line and "rest_length" in line
    before = recorded(rope(), (), SPLITS, seed=100, frames=40)
    before[2] = without(before[2], [5, 7], slice(None))
    against = ("--reference", str(write(tmp_path / "never_before", before)))
    assert f"reference, {e.name}:" in refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", *against)
    once = write(tmp_path / "once", [*dragged[:2], without(e, [5], slice(1, None)), *dragged[3:]])
    line = refusal(capsys, once, world / "twin", tmp_path / "out")
    assert f"{e.name}: no window" in line and "40 frames, id 5 in 1" in line


def test_a_reference_of_another_rate(
    world: Path, tmp_path: Path, dragged: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    def faster(e: Episode) -> Episode:
        stamps = e.stamps[0] + (e.stamps - e.stamps[0]) // 2
        return dataclasses.replace(e, stamps=stamps, tracks=dataclasses.replace(e.tracks, stamp=stamps))

    before = recorded(rope(), (), SPLITS, seed=100, frames=40)
    against = ("--reference", str(write(tmp_path / "before", [faster(e) for e in before], rate=60.0)))
    line = refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", *against)
    assert f"reference, {dragged[0].name}: the reference's frames" in line and "got 0.01666" in line
    assert "--reference recorded at the data set's rate" in line
    after = write(tmp_path / "after", [faster(e) for e in dragged], rate=60.0)
    line = refusal(capsys, after, world / "twin", tmp_path / "out", *against)
    assert "Identify a twin at this rate" in line  # both come at it: it is the twin that differs


def test_a_damaged_journal(world: Path, found: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    text = (found / "journal.jsonl").read_text().splitlines()
    text[3] = text[3][:30]
    (tmp_path / "out" / "journal.jsonl").write_text("\n".join(text) + "\n")
    against = ("--reference", str(world / "reference"))
    line = refusal(capsys, world / "suspect", world / "twin", tmp_path / "out", *against)
    assert "journal.jsonl: is damaged" in line and "Delete it" in line

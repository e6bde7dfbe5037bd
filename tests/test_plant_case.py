"""Cases keep the bag contract, can be resumed, and tell nothing but what the tracker saw."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from plant_cases import CLEAN, TINY, hurry

from pred_core.bag.dataset import load_dataset
from pred_core.cli.main import main
from pred_core.errors import ConfigError, DatasetError
from pred_core.plant.case import truth_path
from pred_core.plant.hidden.library import LIBRARY
from pred_core.plant.rope_case import write_rope_case
from pred_core.plant.sensing import SensorConfig, draw_seen
from pred_core.plant.session import SessionConfig, plan_session
from pred_core.types import Episode


def quiet(done: int, total: int, name: str) -> None:
    pass


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six train, two test, three out-of-distribution episodes of 0.4 s, with a wind, by the command line."""
    root = tmp_path_factory.mktemp("plant") / "one"
    with pytest.MonkeyPatch.context() as patch:
        hurry(patch)
        command = ["plant", "rope", "--effect", "wind", "--magnitude", "4", "--seed", "3", "--out", str(root)]
        assert main([*command, "--episodes", "6", "2", "3", "--seconds", "0.4"]) == 0
    return root


def test_a_case_is_a_data_set(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(case)]) == 0 and "ready for pred identify" in capsys.readouterr().out
    dataset = load_dataset(case)
    assert [len(dataset.select(s)) for s in ("train", "test", "ood")] == [6, 2, 3]
    episodes = list(dataset.episodes())
    ends: dict[str, set[tuple[int, ...]]] = {"train": set(), "test": set(), "ood": set()}
    before = 0
    for episode in episodes:
        ends[episode.split].add(tuple(episode.tracks.id[episode.held == 0].tolist()))
        # What is held is measured in the jaws: the end of the rope, within 5 sigma of the gripper.
        end = 0 if episode.held[0] == 0 else 29
        off = episode.position[0, end] - episode.grips.position[0, 0].numpy()
        assert np.abs(off).max() < 5 * dataset.sigma
        assert episode.stamps[0] > before  # one session, one clock
        before = int(episode.stamps[-1])
        assert episode.state_at(1).position.isfinite().all()
    assert ends == {"train": {(0, 1)}, "test": {(0, 1)}, "ood": {(0, 1), (28, 29)}}
    recordings: dict[int, set[str]] = {}
    for episode in episodes:
        recordings.setdefault(episode.recording, set()).add(episode.split)
    assert len(recordings) == 4 and all(len(splits) == 1 for splits in recordings.values())


def test_an_episodes_own_held_is_checked(case: Path, tmp_path: Path) -> None:
    for file in case.glob("*.mcap"):
        (tmp_path / file.name).symlink_to(file)
    text = (case / "dataset.yaml").read_text()
    assert "    28: 0\n" in text
    (tmp_path / "dataset.yaml").write_text(text.replace("    28: 0\n", "    28: left\n"))
    with pytest.raises(ConfigError, match="ep0.*held.*left"):
        load_dataset(tmp_path)


def test_a_case_goes_on_where_it_stopped(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)
    whole = {e.name: e for e in load_dataset(case).episodes()}
    kept = {f.name: f.stat().st_mtime_ns for f in case.glob("*.mcap") if f.name != "ep004.mcap"}
    (case / "ep004.mcap").unlink()
    (case / ".ep005.mcap.part").write_bytes(b"cut off")
    command = ["plant", "rope", "--effect", "wind", "--magnitude", "4", "--seed", "3", "--out", str(case)]
    assert main([*command, "--episodes", "6", "2", "3", "--seconds", "0.4"]) == 0
    assert {f.name: f.stat().st_mtime_ns for f in case.glob("*.mcap") if f.name != "ep004.mcap"} == kept
    again = next(e for e in load_dataset(case).episodes() if e.name == "ep004")
    assert np.array_equal(again.position, whole["ep004"].position, equal_nan=True)
    assert not list(case.glob(".*.part"))
    # Another case does not go into the same folder.
    session = SessionConfig(6, 2, 3, 0.4)
    with pytest.raises(DatasetError, match="holds another case.*hidden"):
        write_rope_case(case, (("wind", 5.0),), 3, quiet, session=session)


def test_bad_requests_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "x")]
    for words, hint in (
        (["--effect", "wnd"], "did you mean 'wind'"),
        (["--effect", "wind", "--magnitude", "99"], "0 to 15 m/s"),
        (["--magnitude", "3"], "without an effect"),
        (["--effect", "wind", "--effect", "creep", "--magnitude", "3"], "one an effect, 2"),
        (["--effect", "wind", "--effect", "wind"], "each once"),
        (["--episodes", "0", "0", "0"], "at least one"),
        (["--seed", "-1"], "0 or more"),
        (["--rate", "1e9"], "1.0 to 150.0 Hz"),
    ):
        assert main(["plant", "rope", *words, *out]) == 2
        line = capsys.readouterr().err
        assert hint in line and line.count("\n") == 1, words
    assert not (tmp_path / "x").exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert main(["plant", "rope", "--out", str(tmp_path / "full")]) == 2
    assert "not empty" in capsys.readouterr().err
    assert main(["plant", "effects"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in LIBRARY)


def test_without_mujoco_only_this_command_is_missing(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["plant", "effects"]) == 2 and "pip install mujoco" in capsys.readouterr().err
    code = "import sys; sys.modules['mujoco'] = None; from pred_core.cli.main import main; main(['--help'])"
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0 and "plant" in done.stdout, done.stderr


def fingerprint(episode: Episode) -> str:
    """Everything of an episode but where the particles are."""
    t, g = episode.tracks, episode.grips
    arrays = (episode.stamps, t.id, t.visible, t.confidence, g.position, g.rotation, g.closed, episode.held)
    return hashlib.sha256(b"".join(np.asarray(a).tobytes() for a in arrays)).hexdigest()


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, str, str, np.ndarray]]:
    """(seed, effect, everything that is not a particle's place, gripper features), every effect at its strongest."""
    rows = []
    folder = tmp_path_factory.mktemp("told")
    with pytest.MonkeyPatch.context() as patch:
        hurry(patch)
        for number, name in enumerate(["none", *LIBRARY]):
            for seed in (0, 1 + number % 3):
                for hidden in ((), ((name, min(10 * LIBRARY[name].minimum, LIBRARY[name].high)),)) if number else ((),):
                    root = folder / f"{name}_{seed}_{len(hidden)}"
                    if seed and number % 4:
                        continue
                    session = SessionConfig(train=1, test=0, ood=0, seconds=0.2)
                    dataset = write_rope_case(root, hidden, seed, quiet, session=session)
                    episode = next(dataset.episodes())
                    text = (root / "dataset.yaml").read_text() + " ".join(sorted(f.name for f in root.iterdir()))
                    motion = episode.grips.position[:, 0].numpy()
                    features = np.concatenate([motion.mean(0), motion.std(0), np.diff(motion, axis=0).std(0)])
                    rows.append((seed, "hidden" if hidden else "none", fingerprint(episode) + text, features))
    return rows


def test_nothing_but_the_tracks_depends_on_what_is_hidden(told: list[tuple[int, str, str, np.ndarray]]) -> None:
    for seed in {row[0] for row in told}:
        assert len({row[2] for row in told if row[0] == seed}) == 1, seed
    assert len({row[2] for row in told}) == 4  # other seeds do differ


def probe(told: list[tuple[int, str, str, np.ndarray]], generator: np.random.Generator) -> float:
    """Share of right answers of a nearest neighbour that learns one half of the cases and is asked about the other.

    It is asked equally often about cases with and without an effect, seed by seed.
    """
    right, total = 0, 0
    for _ in range(20):
        train = generator.random(len(told)) < 0.5
        known = [row for row, t in zip(told, train, strict=True) if t]
        for seed in sorted({row[0] for row in told}):
            asked = [[r for r, t in zip(told, train, strict=True) if not t and r[:2] == (seed, k)] for k in LABELS]
            for row in (row for rows in asked for row in rows[: min(map(len, asked))]):
                distance = [np.abs(row[3] - k[3]).sum() for k in known]
                right += known[int(np.argmin(distance))][1] == row[1]
                total += 1
    assert total > 100
    return right / total


LABELS = ("none", "hidden")


def test_a_probe_on_motion_scores_at_chance(told: list[tuple[int, str, str, np.ndarray]]) -> None:
    """Equal motions get equal answers, so exactly half are right; motions that differ by 1 um would give all away."""
    generator = np.random.default_rng(0)
    assert probe(told, generator) == 0.5
    leaking = [(seed, label, text, features + 1e-6 * (label == "hidden")) for seed, label, text, features in told]
    assert probe(leaking, generator) > 0.9


def test_the_truth_stands_beside_the_case_and_not_in_it(case: Path) -> None:
    truth = json.loads(truth_path(case).read_text())
    assert truth["hidden"] == [{"effect": "wind", "magnitude": 4.0, "unit": "m/s"}] and truth["seed"] == 3
    for file in case.iterdir():
        assert b"wind" not in file.read_bytes() and "wind" not in file.name


def test_the_tracker_is_as_good_as_it_says() -> None:
    """60 s: noise and wander add to sigma; occlusions, drop-outs and lost frames are as drawn."""
    sensor = SensorConfig()
    seen = draw_seen(sensor, np.random.default_rng(1), 60.0, 30)
    assert seen.error.std() == pytest.approx(np.hypot(sensor.noise, sensor.wander), rel=0.02)
    period = np.diff(seen.time)
    assert np.median(period) == pytest.approx(1 / 30, rel=0.01) and period.max() < 2.5 / 30
    assert np.abs(seen.time * 30 - np.round(seen.time * 30)).std() / 30 == pytest.approx(6e-4, rel=0.3)
    assert 0.995 > seen.visible.mean() > 0.97 and seen.visible[:3].all()
    assert 1 <= 1800 - len(seen.time) <= 20
    clean = draw_seen(CLEAN, np.random.default_rng(1), 1.0, 30)
    assert clean.visible.all() and not clean.error.any() and clean.time == pytest.approx(np.arange(30) / 30)


def test_a_session_has_its_families() -> None:
    plans = plan_session(SessionConfig(), 0)
    assert [sum(p.split == s for p in plans) for s in ("train", "test", "ood")] == [12, 6, 6]
    kinds = {(p.motion.regime, p.motion.variant) for p in plans if p.split == "ood"}
    assert kinds == {(r, v) for r in ("air", "table") for v in ("fast", "height", "regrasp")}
    for split in ("train", "test"):
        regimes = [p.motion.regime for p in plans if p.split == split]
        assert regimes.count("air") == regimes.count("table")
    starts = [p.start for p in plans]
    assert starts == sorted(starts) and starts[1] == 8.0
    assert TINY.train == 2
    with pytest.raises(ConfigError):
        write_rope_case(Path("never"), (("nothing", 1.0),), 0, quiet)

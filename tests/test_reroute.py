"""Trials of leading a rope through the slot: repeatable bit for bit, kept when run again; scores worked by hand."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_modules import loaded_modules

from pred_core.errors import ConfigError, TwinError
from pred_core.plan.config import MotionConfig, PlannerConfig
from pred_core.plan.curve import Curve
from pred_core.plan.knots import KnotLimits
from pred_core.plan.task import load_settings, with_gap
from pred_core.plan.ways import draw_ways
from pred_core.plant.live.slot import SlotConfig
from pred_core.springmass import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import ObjectInfo, Physics, Scene

FOLDER = Path(__file__).parents[1] / "benchmarks"
MODULES = ("argument_types", "hidden_scores", "measured_cables", "reroute_cell", "reroute_eyes", "reroute_trial",
           "reroute_figures", "reroute_scores", "reroute", "reroute_foresight", "rope_tasks")  # fmt: skip


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    yield from loaded_modules(MODULES)


@pytest.fixture(scope="module")
def twin() -> Twin:
    """A rope of 12 particles like the cell's."""
    x = np.zeros((12, 3))
    x[:, 0], x[:, 2] = 0.45 - np.linspace(0.0, 0.7, 12), 0.1
    physics = Physics(stiffness=30.0, damping=0.01, connection_threshold=0.07, max_springs=2, bending_stiffness=3e-4)
    meta = TwinMeta(object=ObjectInfo("rope", "line"), period=1.0 / 15.0, held=((0, 0), (1, 0)))
    return Twin(meta, build_body("line", x, 0.05, physics, radius=0.004), physics, Scene(ground=0.0))


@pytest.fixture(scope="module")
def settings() -> PlannerConfig:
    """The shipped ones with a tiny budget."""
    shipped = load_settings(str(FOLDER.parent / "config" / "plan" / "slot.yaml"))
    return dataclasses.replace(shipped, search=dataclasses.replace(shipped.search, samples=16, iterations=2))


def goal_file(bench: dict[str, ModuleType], folder: Path, seed: int) -> None:
    """A goal that needs no demonstration: the rope straight through the gap."""
    goal = np.zeros((12, 3))
    goal[:, 0], goal[:, 1], goal[:, 2] = 0.45, np.linspace(0.2, -0.5, 12), 0.004
    folder.mkdir(exist_ok=True)
    (folder / f"gap24-cable0-p12-{seed}.json").write_text(json.dumps(goal.tolist()))


def without_clock(result: dict[str, Any]) -> dict[str, Any]:
    """Everything but the time that computing took."""
    replans = [{k: v for k, v in r.items() if k not in ("wall", "cpu")} for r in result["replans"]]
    return {**{k: v for k, v in result.items() if k != "cpu_seconds"}, "replans": replans}


def test_a_trial_is_repeatable_bit_for_bit(bench, twin: Twin, settings: PlannerConfig, tmp_path: Path) -> None:
    goal_file(bench, tmp_path, 3)
    trial = bench["reroute_trial"]
    config = trial.TrialConfig(limit=1.0)
    first, second = (trial.run_trial(twin, settings, config, 3, tmp_path) for _ in range(2))
    assert without_clock(first) == without_clock(second)
    assert first["outcome"] == "time is up" and not first["success"]
    # Replans at 0, 0.4 and 0.8 s; the look after that comes at 1.2 s, when the time is up.
    assert [r["at"] for r in first["replans"]] == [0.0, 0.4, 0.8]
    assert not first["refused"] and [t for t, _ in first["chamfer"]] == [0.0, 0.4, 0.8, 1.2]
    assert first["state_error_mm"] == [0.0, 0.0, 0.0], "true eyes see the truth"
    moved = np.linalg.norm(np.array(first["way"][-1]) - first["way"][0])
    assert 0.02 < moved < 0.24, "the arm followed, no faster than 0.22 m/s from 0.2 s on"


def test_a_plan_the_arm_does_not_follow_is_given_up(bench, twin, settings, tmp_path: Path, monkeypatch) -> None:
    """As in the planner node: more than 4 cm off what is in force, then nothing until the arm has rested."""
    goal_file(bench, tmp_path, 3)
    trial = bench["reroute_trial"]
    monkeypatch.setattr(bench["reroute_cell"].DrivenCell, "follow", lambda self, plan: None)
    result = trial.run_trial(twin, settings, trial.TrialConfig(limit=2.0), 3, tmp_path)
    assert np.ptp(result["way"], axis=0).max() < 2e-3, "the arm stands"
    # What the arm was told moves on by up to 0.22 m/s; looks come every 0.4 s, a rest is seen by two of them.
    counts = result["session"]
    assert counts["off_track"] >= 1 and counts["moving"] >= 1
    assert counts["plans"] == len(result["replans"]) and counts["plans"] + counts["moving"] == 5


def test_out_of_the_arms_reach_ends_a_trial(bench, twin, settings, tmp_path: Path, monkeypatch) -> None:
    """A failure that counts, as the arm's fault in the live cell; no trial that is left out."""
    goal_file(bench, tmp_path, 3)
    cell = bench["reroute_cell"]
    far = cell.ToolPose(np.array([0.8, 0.3, 0.3]), np.array([0.0, 1.0, 0.0, 0.0]))  # 0.9 m from the base
    begin: list[Any] = []

    def setpoint(self: Any) -> Any:
        here = self.station.cell.reference
        begin.append(here)
        share = min(1.0, 0.02 * len(begin))  # 75 Hz: there within 0.7 s, out of reach before
        return cell.ToolPose((1.0 - share) * begin[0].position + share * far.position, here.rotation)

    monkeypatch.setattr(cell.DrivenCell, "_setpoint", setpoint)
    monkeypatch.setattr(cell.Guard, "measured", lambda *_: None)  # it would see that its set-point is not followed
    trial = bench["reroute_trial"]
    result = trial.run_trial(twin, settings, trial.TrialConfig(limit=3.0), 3, tmp_path)
    assert result["outcome"].startswith("arm stopped: ") and "out of the arm's reach" in result["outcome"]
    assert not result["success"] and 0.2 <= result["chamfer"][-1][0] <= 1.2


def test_what_is_there_is_kept(bench, twin: Twin, tmp_path: Path, monkeypatch, capsys) -> None:
    reroute = bench["reroute"]
    for name in ("spring-mass", "pred"):
        twin.save(tmp_path / name)
    config = bench["reroute_trial"].TrialConfig()
    settings = str(FOLDER.parent / "config" / "plan" / "slot.yaml")
    folder = reroute.trial_folder(tmp_path, "pred", config)
    reroute.claim_folder(folder, reroute.about(tmp_path / "pred", settings, config))
    (folder / "8000.json").write_text("{}")
    ran = []

    class Here:
        """Runs jobs in this process, and writes down which."""

        def __init__(self, *_: object, **__: object):
            pass

        def __enter__(self) -> Here:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def submit(self, _: object, *job: Any) -> Any:
            ran.append((job[0].name, job[3]))
            return type("Done", (), {"result": lambda self: ("done", True)})()

    monkeypatch.setattr(reroute, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(reroute, "as_completed", list)
    monkeypatch.setattr(sys, "argv", ["reroute", "run", "--work", str(tmp_path), "--trials", "2"])
    assert reroute.main() == 0
    assert ran == [("spring-mass", 8000), ("spring-mass", 8001), ("pred", 8001)]
    twin.replace(physics=dataclasses.replace(twin.physics, stiffness=31.0)).save(tmp_path / "pred")
    assert reroute.main() == 2, "another twin's trials are not mixed in"
    assert "pred-truth-gap24-cable0" in capsys.readouterr().err


def trial_result(seed: int, success: bool, end: float) -> dict[str, Any]:
    return {
        "seed": seed, "success": success, "outcome": "through" if success else "time is up", "time": 4.0 + seed,
        "chamfer": [[0.0, 0.3], [0.4, end]], "state_error_mm": [1.0, 3.0], "refused": [], "cpu_seconds": 10.0,
        "replans": [{"at": 0.0, "wall": 1.0, "cpu": 0.5, "motions": 256}],
        "touch_seconds": {"rope on slot": 0.5}, "touch_count": {"gripper on slot": 1},
    }  # fmt: skip


def test_scores_are_the_hand_worked_ones(bench) -> None:
    trials = [trial_result(0, True, 0.1), trial_result(1, True, 0.2), trial_result(2, False, 0.3)]
    score = bench["reroute_scores"].score(trials)
    assert (score["trials"], score["successes"], score["hand_on_slot"]) == (3, 2, 3)
    # Clopper-Pearson for 2 of 3: P(X >= 2 | p) = 3 p^2 - 2 p^3 = 0.025 at 0.0943, P(X <= 2 | p) = 1 - p^3 = 0.025.
    assert score["interval"][0] == pytest.approx(0.0943, abs=1e-4)
    assert score["interval"][1] == pytest.approx(0.975 ** (1 / 3), abs=1e-9)
    assert score["seconds_to_success"] == pytest.approx(4.5)
    assert score["chamfer_end_mm"] == pytest.approx(200.0)
    assert score["failed"] == [{"seed": 2, "outcome": "time is up"}]


def test_ten_of_ten_is_no_certainty(bench) -> None:
    score = bench["reroute_scores"].score([trial_result(k, True, 0.1) for k in range(10)])
    assert score["interval"] == pytest.approx([0.025 ** 0.1, 1.0]), "p^10 = 0.025 at 0.69"


def test_twins_are_compared_on_the_same_starts(bench) -> None:
    scores = bench["reroute_scores"]
    # 5 to 0 of differing pairs: 2 / 2^5; 3 to 1: 2 (1 + 4) / 16; nothing differs: 1.
    assert scores.sign_test(5, 0) == scores.sign_test(0, 5) == pytest.approx(1 / 16)
    assert (scores.sign_test(3, 1), scores.sign_test(0, 0), scores.sign_test(2, 2)) == pytest.approx((0.625, 1, 1))
    groups = {
        "pred-truth-gap24-cable0": [trial_result(k, k != 3, 0.1) for k in range(4)],
        "spring-mass-truth-gap24-cable0": [trial_result(k, k == 0, 0.1) for k in range(1, 5)],
        "pred-cameras-gap24-cable0": [trial_result(0, True, 0.1)],
    }
    line = scores.paired_line(groups, "truth-gap24-cable0")
    assert "3 same starts: only pred 2, only spring-mass 0" in line and "p = 0.5" in line
    assert scores.paired_line(groups, "cameras-gap24-cable0") == ""


def test_the_median_curve_keeps_what_a_trial_ended_with(bench) -> None:
    short, long = trial_result(0, True, 0.1), trial_result(1, False, 0.3)
    long["chamfer"] = [[0.0, 0.3], [0.8, 0.3]]
    times, values = bench["reroute_figures"].curve([short, long])
    assert times.tolist() == pytest.approx([0.0, 0.4, 0.8])
    assert values.tolist() == pytest.approx([300.0, 200.0, 200.0])


def test_ways_lead_to_the_goal_over_a_height_and_keep_the_limits() -> None:
    limits = KnotLimits(MotionConfig(horizon=4.0, knots=16, speed=0.3, z_high=0.3))
    start, goal = np.array([[0.45, -0.1, 0.05]]), np.array([[0.45, 0.12, 0.04]])
    samples = draw_ways(goal, start, 40, 0.3, limits, np.random.default_rng(0))
    knots = limits.apply(samples, np.zeros((2, 1, 4)), start)
    heights, ends = [], []
    for k in range(40):
        curve = Curve(limits.spacing, start, np.array([[1.0, 0.0, 0.0, 0.0]]), knots[:, k])
        place = curve.poses(np.arange(0.0, 4.0, 0.05))[0]
        heights.append(place[:, 0, 2].max())
        ends.append(np.linalg.norm(place[-1, 0] - goal[0]))
    # Two of three go over posts of 0.1 m with a hand; ends scatter by 3 cm an axis: sqrt(3) 3 cm = 5 cm.
    assert np.mean(np.array(heights) > 0.13) > 0.5
    assert np.median(ends) < 0.07


def test_scripted_hands_of_the_four_tasks(bench) -> None:
    tasks = bench["rope_tasks"]
    rope = load_settings(str(tasks.SETTINGS))
    hand, end = np.array([0.45, -0.15, 0.07]), np.array([0.45, -0.35, 0.004])
    truth = SimpleNamespace(gripper=SimpleNamespace(position=hand), rope=np.stack([hand, end]))
    assert tasks.hand_of("lift", truth, rope) == pytest.approx([0.45, -0.15, 0.25])
    assert tasks.hand_of("lower", truth, rope) == pytest.approx([0.45, -0.15, 0.03])
    turned = tasks.hand_of("rotate", truth, rope)
    assert np.linalg.norm(turned[:2] - end[:2]) == pytest.approx(0.2) and turned[2] == pytest.approx(0.07)
    assert abs(turned[0] - 0.45) == pytest.approx(0.2 * np.sin(0.6))
    # 45 % of 0.2 m towards the end, 8 cm aside.
    bent = tasks.hand_of("bend", truth, rope)
    assert (abs(bent[0] - 0.45), bent[1]) == pytest.approx((0.08, -0.24))


def test_looked_at_once_a_plan_is_carried_out_whole(bench) -> None:
    """The same task but for the search, which has one plan's time; the arm rests before the trial is measured."""
    tasks = bench["rope_tasks"]
    usual, once = load_settings(str(tasks.SETTINGS)), load_settings(str(tasks.SETTINGS_ONCE))
    assert dataclasses.replace(once, send=usual.send, search=usual.search) == usual
    assert once.send == once.motion.horizon
    assert once.motion.horizon + bench["reroute_trial"].TrialConfig().latency < tasks.REST


def hanging(twin: Twin) -> np.ndarray:
    """(N, 3) [m] the twin's rope straight down from 1.1 m: each spring is strained by the weight below it over its
    stiffness, 0.45 N / 30 N = 1.5 % at the hand."""
    below = 9.81 * np.cumsum(twin.body.mass[::-1])[::-1][1:]
    rope = np.tile([0.45, 0.0, 1.1], (twin.body.count, 1))
    rope[1:, 2] -= np.cumsum(0.7 / 11 * (1.0 + below / twin.physics.stiffness))
    return rope


@pytest.mark.parametrize("hand_goes", [True, False], ids=["carried", "drifting"])
def test_foresight_of_a_hanging_rope(bench, twin: Twin, hand_goes: bool) -> None:
    """Its truth goes sideways at 10 mm/s: who predicts no motion misses 10, 20, 30 mm. Carried by the hand, the twin's
    goes along and misses nothing; if the hand stays, nothing moves the twin's, and it misses as much.

    The rope hangs in equilibrium: what is left is rounding to float32, 1e-4 mm in a metre, swinging on; ten times it.
    """
    foresight = bench["reroute_foresight"]
    rope, speed = hanging(twin), np.array([0.01, 0.0, 0.0])
    kept = []
    for k in range(62):  # 4 s and the period they begin with: predicted from 0 s and 1 s
        along = speed * k / 15.0
        hand = SimpleNamespace(position=rope[0] + hand_goes * along, rotation=np.array([0.0, 1.0, 0.0, 0.0]))
        truth = SimpleNamespace(rope=rope + along, rope_velocity=0.0 * rope + hand_goes * speed, gripper=hand)
        kept.append(SimpleNamespace(truth=truth))
    assert foresight.moved(twin, kept) == pytest.approx(np.array([[10.0, 20.0, 30.0]] * 2), rel=1e-3)
    missed = foresight.errors(twin, bench["reroute_trial"].TrialConfig(), kept)
    wanted = 0.0 if hand_goes else np.array([[10.0, 20.0, 30.0]] * 2)
    assert missed.shape == (2, 3) and np.abs(missed - wanted).max() < 0.005


def test_unusable_twins_and_settings_are_refused(bench, twin: Twin, settings: PlannerConfig) -> None:
    trial = bench["reroute_trial"]
    with pytest.raises(TwinError, match="no rope of the cell"):
        trial.check_twin(twin.replace(meta=dataclasses.replace(twin.meta, held=())))
    with pytest.raises(ConfigError, match="no slot"):
        with_gap(dataclasses.replace(settings, slot=None), SlotConfig.gap)


@pytest.mark.parametrize(
    ("module", "words", "line"),
    [
        ("rope_tasks", ["--jobs", "0"], "argument --jobs: got '0'; allowed: 1 to 256"),
        ("rope_tasks", ["--trials", "-3"], "argument --trials: got '-3'; allowed: 1 to 1000000"),
        ("reroute_foresight", ["--gap", "-1"], "argument --gap: got '-1'; allowed: 0.01 to 0.1"),
        ("reroute_foresight", ["--trials", "nan"], "argument --trials: got 'nan'"),
    ],
)
def test_numbers_out_of_range_are_refused_in_a_line(
    bench, module: str, words: list[str], line: str, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr(sys, "argv", [module, "--work", "nowhere", *words])
    with pytest.raises(SystemExit) as end:
        bench[module].main()
    assert end.value.code == 2 and line in capsys.readouterr().err.splitlines()[-1]

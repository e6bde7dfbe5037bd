"""The loop as processes: pictures to arm commands, a killed node, and what is left behind; and the judge by hand."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from mcap.reader import make_reader
from sensor_msgs.msg import Image

from pred_core.errors import PredError
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.success import Passage, judge_passage
from pred_ros import bringup, convert, reroute, reroute_loop
from pred_ros.camera_pairs import CameraPairs
from pred_ros.processes import Children
from pred_ros.reroute_faults import FAULTS
from pred_ros.reroute_record import PlanSeen, Record, Said
from pred_ros.reroute_report import timeline, write_report
from pred_ros.reroute_verdict import errors, goal_distances, judge
from pred_ros.tracker_node import parse_fixtures

ROOT = Path(__file__).parents[1]
S = 1_000_000_000  # [ns]
SETTINGS = """
motion: {horizon: 1.0, knots: 4}
search: {samples: 16, chunk: 16, iterations: 1, frames: 4}
"""
HARD = 400.0  # [s] after which a run is killed


def light(folder: Path, *more: str) -> list[str]:
    """Command line of a light run on the same path: a gripper without an arm, small pictures, few motions."""
    settings = folder / "settings.yaml"
    settings.write_text(SETTINGS, encoding="utf-8")
    goal = folder / "goal.npy"  # on the near side of the slot: so few motions would not find through it
    np.save(goal, reroute.through_slot(SlotConfig(), 0.5) - [0.0, 0.3, 0.0])
    return [
        sys.executable, "-m", "pred_ros.reroute", "--out", str(folder / "out"), "--goal", str(goal),
        "plant.mover=free", "plant.factor=0.25", "plant.cameras=3", "plant.camera_rate=6.0", "plant.width=320",
        "plant.height=240", "tracker.cameras=cam0 cam1 cam2", f"planner.settings={settings}", *more,
    ]  # fmt: skip


def run(command: list[str]) -> tuple[int, str]:
    """Exit code and output; a run that hangs is killed with all its processes."""
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    try:
        said, _ = process.communicate(timeout=HARD)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=120.0)
        raise AssertionError(f"not over after {HARD:g} s: {said}") from None
    return process.returncode, said


def processes_of(folder: Path) -> list[str]:
    """Command lines of living processes that name a folder."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = entry.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it ended in the meantime
            continue
        if str(folder) in line and entry.parent.name != str(os.getpid()):
            found.append(line)
    return found


def test_a_killed_tracker_stops_the_arm_and_is_taken_up_again(tmp_path: Path) -> None:
    # A tracker takes its time to start on a loaded machine: 8 s of the cell are half a minute and more on the wall.
    code, said = run(light(tmp_path, "--fault", "tracker_killed", "--fault-at", "1.0", "--limit", "12.0"))
    assert code in (0, 1), said
    out = tmp_path / "out"
    result = json.loads((out / "reroute.json").read_text())
    fault = result["fault"]
    assert fault["name"] == "tracker_killed" and fault["safe"] and fault["collisions"] == 0, said
    assert fault["named"].startswith(("predictor:", "planner:")), result["said"]
    assert result["replans"] > fault["plans_after"] > 0, "it planned before, and again after the tracker came back"
    assert result["tracker_error"]["median"] < 0.01, "320 pixels: one is 3 mm at 1 m"
    with (out / "run.mcap").open("rb") as stream:
        topics = {c.topic for _, c, _ in make_reader(stream).iter_messages()}
    assert {"tracker/points", "state/points", "plan/trajectory", "goal/points", "gripper/pose", "gripper/closed",
            "joint_states", "/diagnostics", "cam0/color/image_raw/compressed"} - topics == {"joint_states"}  # fmt: skip
    assert not [t for t in topics if "truth" in t], "the truth is the judge's alone"
    assert "data:video/webm" in (out / "report.html").read_text() and (out / "video.webm").stat().st_size > 10_000
    assert processes_of(tmp_path) == []


def test_a_node_that_fails_ends_the_run_with_its_own_line(tmp_path: Path) -> None:
    code, said = run(light(tmp_path, "tracker.cameras=''", "--no-pictures"))
    assert code == 2
    assert "the tracker ended with code 2" in said and "parameter 'cameras'" in said
    assert processes_of(tmp_path) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--twin", "nowhere"], "nowhere"),
        (["plant.gap"], "NODE.PARAMETER=VALUE"),
        (["camera.rate=3"], "plant, tracker, predictor, planner, arm"),
        (["--goal", "goal.png"], "unknown kind of cloud"),
        (["--goal", "goal.npy", "--twin", "nowhere"], "nowhere"),
        (["predictor.twin=nowhere"], "nowhere"),
        (["--limit", "nan"], "--limit"),
        (["--seed", "-1"], "--seed"),
        (["tracker.fixtures=abc"], "abc"),
        (["--fault", "slip", "--limit", "2"], "Give a longer --limit"),
        (["--nodes", "config/nodes/live.yaml"], "plant, tracker, planner, arm missing"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], words: str, capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    assert reroute.main([*arguments, "--out", str(tmp_path)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and words in lines[0]


def test_a_killed_node_is_gone_and_comes_back_under_watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import sys, time; time.sleep(float(sys.argv[1])); sys.exit('tired')"
    monkeypatch.setattr(
        reroute_loop, "node_command", lambda node, given: [sys.executable, "-S", "-c", code, str(given["for"])]
    )
    nodes = {"tracker": {"for": 300.0}, "arm": {"for": 300.0}}
    watch: Any = SimpleNamespace(record=record_of([(0.0, 0.0)]), spin=time.sleep)
    with Children(dict(os.environ), tmp_path) as children:
        loop = reroute_loop.Loop(reroute_loop.Job(nodes, np.zeros((1, 3)), tmp_path, 60.0), children, watch)
        for node, parameters in nodes.items():
            children.start(node, reroute_loop.node_command(node, parameters))
        loop.kill("tracker")
        loop.check()  # nobody minds that it is gone
        assert set(children.running) == {"arm"}
        nodes["tracker"]["for"] = 0.0
        loop.restart("tracker")
        with pytest.raises(PredError, match="the tracker_2 ended with code 1; got tired"):
            loop.wait(lambda: False, 60.0, "the end")
        loop.kill("tracker")  # also under its new name
        loop.check()


def record_of(path: list[tuple[float, float]]) -> Record:
    """A gripper at x [m] at times [s]."""
    record = Record(SlotConfig(), np.zeros((1, 3)))
    record.gripper = [(round(t * S), np.array([x, 0.0, 0.1])) for t, x in path]
    record.now = record.gripper[-1][0]
    return record


def test_rest_and_speed_of_a_gripper_that_brakes() -> None:
    # 0.2 m/s for 1 s, then still: at rest from 1 s on, to the width of the window that judges it.
    times = np.arange(0.0, 3.0, 0.02)
    record = record_of([(t, 0.2 * min(t, 1.0)) for t in times.tolist()])
    rest = record.rests_from(round(0.2 * S))
    assert rest is not None and rest / S == pytest.approx(1.0, abs=0.03)
    assert record.at_rest() and record.speed(0, record.now) == pytest.approx(0.2, rel=1e-6)
    moving = record_of([(t, 0.2 * t) for t in times.tolist()])
    assert moving.rests_from(0) is None and not moving.at_rest()


def test_errors_are_taken_at_the_same_stamp_and_place_along_the_rope() -> None:
    # The rope moves by 0.1 m/s along z; particles 3 mm beside it, seen between two truths.
    record = record_of([(0.0, 0.0), (2.0, 0.0)])
    line = np.column_stack([np.linspace(0.0, 0.7, 33), np.zeros((33, 2))])
    record.truth = [(k * S, line + [0.0, 0.0, 0.1 * k]) for k in range(3)]
    seen = np.column_stack([np.linspace(0.0, 0.7, 30), np.zeros((30, 2))])
    record.tracked = [(S // 2, seen + [0.0, 0.003, 0.05]), (2 * S, seen + [0.0, 0.004, 0.2]), (5 * S, seen)]
    times, error = errors(record, record.tracked)
    assert times.tolist() == [0.5, 2.0], "what is newer than the truth is not judged"
    assert error == pytest.approx([0.003, 0.004], abs=1e-9)


def test_a_fault_is_named_by_the_node_that_must_and_speed_and_collisions_decide_safety() -> None:
    record = record_of([(t, 0.1 * min(t, 2.0)) for t in np.arange(0.0, 5.0, 0.02).tolist()])
    record.fault, record.values_at_fault = S, {"collisions: gripper on slot": "1", "collisions: rope on slot": "2"}
    record.values["plant"] = {"collisions: gripper on slot": "1", "collisions: rope on slot": "5"}
    record.said = [
        Said(S // 2, "planner", 2, "state/points stopped 0.6 s ago: no planning"),  # before the fault
        Said(2 * S, "arm", 1, "state/points stopped"),  # another node
        Said(3 * S, "planner", 2, "state/points stopped 0.7 s ago: no planning"),
    ]
    record.plans = [PlanSeen(0, 0.0, 0, np.zeros((2, 3)))]
    fault = judge(record, 10.0, 0.25, FAULTS["predictor_killed"]).fault
    assert fault is not None and fault.named.startswith("planner: state/points") and fault.named_after == 2.0
    assert fault.safe and fault.collisions == 0 and fault.plans_after == 0
    assert fault.stopped_after == pytest.approx(1.0, abs=0.05) and fault.speed == pytest.approx(0.1, rel=1e-3)
    record.values["plant"]["collisions: gripper on slot"] = "2"
    assert not judge(record, 10.0, 0.25, FAULTS["predictor_killed"]).fault.safe  # type: ignore[union-attr]
    record.values["plant"]["collisions: gripper on slot"] = "1"
    assert not judge(record, 10.0, 0.05, FAULTS["predictor_killed"]).fault.safe  # type: ignore[union-attr]


def test_the_goal_leads_through_the_gap_and_counts_as_success() -> None:
    goal = reroute.through_slot(SlotConfig(), 0.7)
    assert np.ptp(goal[:, 1]) == pytest.approx(0.69, abs=0.011) and goal[:, 1].max() == pytest.approx(0.16)
    assert judge_passage(goal, goal[0], SlotConfig()).success
    record = Record(SlotConfig(), goal)
    record.truth = [(S, goal + [0.0, 0.0, 0.02])]
    # Both sides are 20 mm from the nearest point where it lies flat, a little less where it rises.
    assert goal_distances(record)[1][0] == pytest.approx(0.04, abs=0.001)


def test_planner_and_tracker_know_the_gap_of_the_plant() -> None:
    given = lambda *more: reroute.prepare(reroute._parser().parse_args(more))  # noqa: E731
    plain, narrow = given(), given("plant.gap=0.016")
    assert (plain["planner"]["gap"], narrow["planner"]["gap"]) == (0.024, 0.016)
    # Posts 9 cm wide and 12 mm thick beside x = 0.45 m: middles half a gap and 45 mm from it.
    wanted = {0.450 - 0.012 - 0.045, 0.450 + 0.012 + 0.045}, {0.450 - 0.008 - 0.045, 0.450 + 0.008 + 0.045}
    for nodes, middles in zip((plain, narrow), wanted, strict=True):
        boxes = parse_fixtures(nodes["tracker"]["fixtures"])
        assert sorted(b.center[0] for b in boxes) == pytest.approx(sorted(middles))
        assert all(b.half_size == pytest.approx((0.045, 0.006, 0.05)) for b in boxes)
    assert given("planner.gap=0.02", "tracker.fixtures=''")["planner"]["gap"] == 0.02
    assert given("tracker.fixtures=''")["tracker"]["fixtures"] == ""


def test_a_file_may_name_other_fixtures_than_the_posts(tmp_path: Path) -> None:
    """A third box stays whatever the gap; a file that names none, or the posts of its own gap, follows the gap."""
    shipped = (ROOT / "config" / "nodes" / "reroute.yaml").read_text()
    posts = next(line for line in shipped.splitlines() if line.strip().startswith("fixtures:"))
    narrow = reroute.fixtures_of(SlotConfig(gap=0.016))
    own = "0.4 0.2 0.05 0.02 0.02 0.05"
    for named, wanted in ((f"    fixtures: '{own}'", own), ("", narrow), (posts, narrow)):
        file = tmp_path / "nodes.yaml"
        file.write_text(shipped.replace(posts, named))
        nodes = reroute.prepare(reroute._parser().parse_args(["--nodes", str(file), "plant.gap=0.016"]))
        assert parse_fixtures(nodes["tracker"]["fixtures"]) == parse_fixtures(wanted), named


@pytest.mark.parametrize(("wrong", "told"), [
    ("plant.fctor=0.5", "parameters of plant: unknown key 'fctor'. did you mean 'factor'?"),
    ("plant.factor=fast", "parameters of plant: factor; got 'fast' (str); allowed: float."),
    ("planner.budget=-1.0", "parameters of planner: budget; got -1.0 s; allowed: "),
    ("planner.settings=3", "parameters of planner: settings; got 3 (int); allowed: str"),
    ("tracker.cameras=[cam0", "override 'tracker.cameras=[cam0'; got a value that is not YAML"),
])  # fmt: skip
def test_what_a_node_would_refuse_is_told_before_any_has_started(
    wrong: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def forbidden(*_: object) -> None:
        raise AssertionError("a node was started")

    monkeypatch.setattr(Children, "start", forbidden)
    assert reroute.main(["--out", str(tmp_path / "out"), wrong]) == 2
    assert bringup.main([str(ROOT / "config" / "nodes" / "reroute.yaml"), wrong]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith(f"pred_reroute: {told}") and second.startswith(f"pred_bringup: {told}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda goal: goal[:, :2], "goal; got an array of shape (70, 2); allowed: (Q, 3)."),
        (lambda goal: goal[:0], "the goal is empty"),
        (lambda goal: goal * np.nan, "not finite; got 70 of 70"),
        (lambda goal: goal + [5.0, 0.0, 0.0], "the goal is out of reach"),
        (lambda goal: goal * 1e3, "are these millimetres?"),
    ],
)
def test_a_goal_the_planner_would_refuse_is_told_before_any_node_has_started(
    change: Any, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def forbidden(*_: object) -> None:
        raise AssertionError("a node was started")

    monkeypatch.setattr(Children, "start", forbidden)
    np.save(tmp_path / "goal.npy", change(reroute.through_slot(SlotConfig(), 0.7)))
    assert reroute.main(["--goal", str(tmp_path / "goal.npy"), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("pred_reroute: ") and words in line
    assert not (tmp_path / "out").exists()


def test_a_run_without_any_plan_is_reported_without_a_warning(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    goal = reroute.through_slot(SlotConfig(), 0.7)
    record = Record(SlotConfig(), goal, now=S, begin=S)
    write_report(record, judge(record, 1.0, 0.25, None), {}, tmp_path)
    assert (tmp_path / "report.html").is_file() and not [str(w.message) for w in recwarn]


def test_success_must_last() -> None:
    record = record_of([(0.0, 0.0), (4.0, 0.0)])
    through, beside = Passage(True, 1, 0.3, 0.1, True), Passage(False, 1, 0.3, 0.1, True)
    record.judged = [(S, through), (2 * S, beside), (3 * S, through), (4 * S, through)]
    assert record.success and record.succeeded_for() == pytest.approx(1.0)


def test_lines_that_differ_in_numbers_are_one_row() -> None:
    record = record_of([(0.0, 0.0), (1.0, 0.0)])
    record.said = [Said(k * S, "planner", 2, f"state/points stopped {k}.5 s ago") for k in range(5)]
    record.said.append(Said(6 * S, "planner", 0, "planning"))
    record.events = [(2 * S, "the predictor is killed")]
    rows, marks = timeline(record)
    assert [(r[1], r[4]) for r in rows] == [("planner", 5), ("run", 1), ("planner", 1)]
    assert marks == ["warn", "warn", ""]


def test_pictures_of_one_instant_stay_together_where_time_runs_slowly() -> None:
    # At a tenth of real time 10 Hz cameras are a second apart on the wall; on their own clock they were heard just now.
    now = [1.0]
    pairs = CameraPairs(["cam0", "cam1"], lambda: now[0])
    assert pairs.silent(1.0) == ["cam0", "cam1"], "nothing came yet"

    def show(name: str, stamp: int) -> None:
        for kind in ("color", "depth"):
            pairs.add_image(name, kind, Image(header=convert.header_at(stamp)))

    show("cam0", S), show("cam1", S)
    assert set(pairs.take(0.0)) == {"cam0", "cam1"}
    now[0] = 1.1
    show("cam0", 11 * S // 10)
    late = threading.Timer(0.2, show, ("cam1", 11 * S // 10))
    late.start()
    assert set(pairs.take(20.0)) == {"cam0", "cam1"}, "it waits for the other one"
    now[0] = 2.2
    show("cam0", 22 * S // 10)
    assert set(pairs.take(20.0)) == {"cam0"}, "a dead one is not waited for"
    assert pairs.silent(1.0) == ["cam1"]

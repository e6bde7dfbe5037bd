"""Laps: one time line for all topics, whatever single stamps say."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from live_world import CLOSED, COUNT, START, STEP, Straight, points, pose

from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.calibration import Calibration
from pred_core.errors import InputError, TwinError
from pred_core.live import run
from pred_core.live.following import Follower
from pred_core.live.laps import AHEAD, Laps
from pred_core.live.marks import EpisodeMark
from pred_core.live.prediction import Predictor
from pred_core.live.prediction_records import Rules
from pred_core.live.scoring import Scorer
from pred_core.springmass.topology import build_body
from pred_core.types import Physics

SECOND = 1_000_000_000
IDS = np.arange(COUNT, dtype=np.uint32)


def predictor(**rules: float) -> Predictor:
    """Five particles flying straight; particle 0 is held."""
    return Predictor(Straight(), IDS, {0: 0}, Rules(**rules))


def follower(delay: float) -> Follower:
    """The same, corrected by its tracks, which are `delay` [s] old when their stamps say now."""
    rest = points(0).position
    physics = Physics(stiffness=100.0, damping=0.05, connection_threshold=0.06, max_springs=4)
    body = build_body("line", rest, 0.05, physics, id=IDS)
    return Follower(Straight(), body, {0: 0}, Rules(), Calibration(delay=delay))


def moved(frame: int, ahead: float) -> PointFrame:
    """Frame k stamped `ahead` [s] too late."""
    seen = points(frame)
    return PointFrame(seen.stamp + round(ahead * SECOND), seen.position, seen.id, seen.confidence, None)


def feed(machine: Predictor | Follower, frames: range) -> list[int]:
    """Pose and points of every frame; returns the frames that were predicted."""
    found = []
    for frame in frames:
        machine.add_pose(pose(frame), CLOSED)
        machine.add_points(points(frame))
        found += [round((p.stamp - START) / STEP) for p in machine.advance()]
    return found


def test_both_topics_share_the_laps() -> None:
    laps: Laps[None] = Laps(0.1)
    times = [laps.take(topic, k * SECOND, None)[0][0] for k in (1, 2, 3, 1, 2) for topic in "ab"]
    assert [lap for lap, _ in times] == [0] * 6 + [1] * 4
    assert laps.take("c", SECOND, None)[0][0] == (1, SECOND), "a topic that comes later joins the newest lap"


def test_a_topic_that_lags_behind_a_loop_joins_it() -> None:
    laps: Laps[None] = Laps(0.1)
    for topic, seconds in (("a", 20), ("b", 18), ("a", 21), ("a", 1)):
        (a,) = laps.take(topic, seconds * SECOND, None)
    assert a[0][0] == 1
    assert laps.take("b", 19 * SECOND, None)[0][0][0] == 0
    assert laps.take("b", 1 * SECOND, None)[0][0][0] == 1


def test_a_late_message_is_refused() -> None:
    laps: Laps[None] = Laps(0.1)
    laps.take("a", SECOND, None)
    with pytest.raises(InputError, match="a: time runs backwards"):
        laps.take("a", SECOND - 50_000_000, None)


def test_a_jump_far_ahead_is_used_only_when_confirmed_and_then_nothing_is_lost() -> None:
    laps: Laps[str] = Laps(0.1)
    laps.take("a", SECOND, "first")
    with pytest.raises(InputError, match=r"a: time jumps 3600\.000 s ahead"):
        laps.take("a", 3601 * SECOND, "far")
    assert laps.take("a", 2 * SECOND, "second") == [((0, 2 * SECOND), "second")]
    with pytest.raises(InputError, match="ahead"):
        laps.take("a", 3601 * SECOND, "far")
    both = laps.take("a", 3602 * SECOND, "next")
    assert both == [((0, 3601 * SECOND), "far"), ((0, 3602 * SECOND), "next")]


@pytest.mark.parametrize("ahead", [0.5, 5.0, 3600.0], ids=lambda s: f"{s} s")
def test_one_cloud_from_the_future_costs_no_prediction(ahead: float) -> None:
    machine = predictor()
    assert feed(machine, range(5)) == [2, 3, 4]
    if ahead * SECOND > AHEAD:
        with pytest.raises(InputError, match="tracker/points: time jumps"):
            machine.add_points(moved(4, ahead))
    else:
        machine.add_points(moved(4, ahead))
    assert feed(machine, range(5, 60)) == list(range(5, 60))
    machine.reset()
    assert feed(machine, range(60, 70)) == list(range(62, 70)), "a new run starts"


def test_a_topic_that_falls_back_alone_and_returns_has_begun_no_lap() -> None:
    laps: Laps[None] = Laps(0.1)
    for topic in "ab":
        laps.take(topic, 20 * SECOND, None)
    for stamp in (1.0, 1.05, 1.1):
        assert laps.take("a", round(stamp * SECOND), None)[0][0][0] == 1
    assert [laps.take(topic, 21 * SECOND, None)[0][0] for topic in "ab"] == [(0, 21 * SECOND)] * 2
    assert [laps.take(topic, SECOND, None)[0][0] for topic in "ab"] == [(1, SECOND)] * 2, "and a loop is a loop"
    with pytest.raises(InputError, match="ahead"):  # no way back to the lap before: the other topic has left it too
        laps.take("a", 22 * SECOND, None)


@pytest.mark.parametrize("behind", [0.5, 5.0, 20.0], ids=lambda s: f"{s} s")
def test_one_cloud_from_the_past_costs_no_prediction(behind: float) -> None:
    machine = predictor()
    feed(machine, range(5))
    machine.add_points(moved(4, -behind))
    assert feed(machine, range(5, 60)) == list(range(5, 60))
    assert machine.counts.dropped_frames == 1


@pytest.mark.parametrize("off", [-20.0, -5.0, -0.5, 0.5, 5.0, 20.0], ids=lambda s: f"{s} s")
@pytest.mark.parametrize("mode", ["Predictor", "Follower", "with a delay"])
def test_one_pose_out_of_line_is_named_and_costs_no_prediction(off: float, mode: str) -> None:
    machine = predictor() if mode == "Predictor" else follower(0.05 if mode == "with a delay" else 0.0)
    first = feed(machine, range(20))
    wrong = pose(19)
    machine.add_pose(PoseFrame(wrong.stamp + round(off * SECOND), wrong.position, wrong.rotation), CLOSED)
    assert list(machine.advance()) == []
    with pytest.raises(InputError, match="gripper/pose: one stamp is out of line; got [+-]"):
        machine.add_pose(pose(20), CLOSED)
    machine.add_points(points(20))
    found = [round((p.stamp - START) / STEP) for p in machine.advance()] + feed(machine, range(21, 40))
    assert sorted(set(first + found)) == list(range(first[0], 40)) and machine.counts.runs == 1


def test_a_hole_in_the_poses_or_a_loop_loses_none() -> None:
    """The first pose behind either waits for the second."""
    machine = predictor()
    feed(machine, range(5))
    assert feed(machine, range(50, 60)) == list(range(52, 60)) and machine.counts.gaps == 1
    assert feed(machine, range(10)) == list(range(2, 10)) and machine.counts.jumps == 1


def test_a_first_cloud_from_the_future_does_not_stop_the_start() -> None:
    machine = predictor()
    machine.add_points(moved(0, 3600.0))
    assert feed(machine, range(20))[-15:] == list(range(5, 20))


def test_reset_forgets_the_stamps() -> None:
    machine = predictor()
    assert feed(machine, range(100, 110))
    machine.reset()
    # Two frames back would be late without the reset.
    assert feed(machine, range(105, 110)) == [107, 108, 109]


def test_a_frame_without_points_is_a_frame_where_nothing_is_seen() -> None:
    empty = PointFrame(START, np.zeros((0, 3)), np.zeros(0, np.uint32), np.zeros(0, np.float32), None)
    machine = predictor()
    machine.add_pose(pose(0), CLOSED)
    machine.add_points(empty)
    assert list(machine.advance()) == []
    assert feed(machine, range(1, 6)) == [3, 4, 5], "the start waits for frames 1 and 2"
    machine.add_points(PointFrame(START + 6 * STEP, empty.position, empty.id, empty.confidence, None))
    machine.add_pose(pose(6), CLOSED)
    assert len(list(machine.advance())) == 1, "the run goes on"
    with pytest.raises(TwinError, match="do not match"):
        machine.add_points(points(7, ids=COUNT + 1))


def test_poses_without_a_tracker_are_bounded_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "MAX_WAITING", 50)
    machine = predictor()
    for frame in range(80):
        machine.add_pose(pose(frame), CLOSED)
        assert list(machine.advance()) == []
    assert len(machine._poses) == 50 and machine.counts.dropped_poses == 30
    assert feed(machine, range(80, 90)) == list(range(82, 90))


def test_cancel_ends_a_long_horizon_at_its_next_step() -> None:
    machine = predictor(horizon=5.0)
    feed(machine, range(3))
    dynamics = machine._dynamics
    assert isinstance(dynamics, Straight)
    dynamics.left = 100  # then the test below would see a divergence
    machine.add_pose(pose(3), CLOSED)
    machine.cancel()
    assert list(machine.advance()) == [] and dynamics.left == 100


def test_cancel_within_a_horizon(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = predictor(horizon=5.0)
    steps = []
    step = Straight.step

    def counted(self: Straight, state, grip):  # type: ignore[no-untyped-def]
        steps.append(1)
        if len(steps) == 10:
            machine.cancel()
        return step(self, state, grip)

    monkeypatch.setattr(Straight, "step", counted)
    assert feed(machine, range(3)) == []
    assert len(steps) == 10  # not the 501 of one measured step and five seconds ahead


def scored(scorer: Scorer, frames: range, ahead: dict[int, float] | None = None) -> None:
    """Measured frames with predictions 3 mm off; `ahead`: frame -> [s] its stamp is wrong."""
    for frame in frames:
        wrong = (ahead or {}).get(frame)
        if wrong is not None:
            scorer.add_points(moved(frame, wrong))
        scorer.add_points(points(frame))
        if frame >= 2:
            scorer.add_prediction(START + frame * STEP, IDS, points(frame).position + [0, 0.003, 0])


def test_one_measured_frame_from_the_future_is_not_a_loop_for_the_score() -> None:
    scorer = Scorer(0.001)
    scored(scorer, range(20), {10: 5.0})
    assert scorer.pairs == 18
    (episode,) = scorer.episodes()
    assert episode.lost == 0 and len(episode.stamps) == 20


def test_a_frame_without_points_does_not_stop_the_score() -> None:
    scorer = Scorer(0.001)
    scorer.add_prediction(START, IDS, points(0).position)
    scorer.add_points(PointFrame(START, np.zeros((0, 3)), np.zeros(0, np.uint32), np.zeros(0, np.float32), None))
    assert scorer.pairs == 0
    (episode,) = scorer.episodes()
    assert not episode.scorable.any()


def test_a_replay_in_a_loop_keeps_the_newest_episodes_only() -> None:
    scorer = Scorer(0.001, most_frames=45)
    for k in range(12):
        scorer.add_mark(EpisodeMark(f"e{k}", k, 12, START + 20 * k * STEP, 20))
        scored(scorer, range(20 * k, 20 * (k + 1)))
        assert len(scorer.points.times) <= 45 and len(scorer.predictions.times) <= 46
    kept = scorer.episodes()
    assert scorer.announced == 12 and scorer.released == 12 - len(kept)
    assert [e.name for e in kept] == ["e10", "e11"] and kept[0].lost == 0
    assert scorer.pairs == 238  # 12 x 20, without the first two
    scored(scorer, range(240, 241))
    assert scorer.complete()


def test_without_marks_the_newest_frames_are_kept() -> None:
    scorer = Scorer(0.001, most_frames=50)
    scored(scorer, range(500))
    assert 40 <= len(scorer.points.times) <= 50 and len(scorer.predictions.times) <= 51
    (episode,) = scorer.episodes()
    assert torch.tensor(episode.stamps[-1]).item() == START + 499 * STEP

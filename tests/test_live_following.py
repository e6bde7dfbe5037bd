"""The follower without any process: late tracks, holes, the end of tracks, a loop."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.errors import DivergenceError
from pred_core.estimate.config import EstimatorConfig
from pred_core.live.following import Follower
from pred_core.live.prediction_records import Prediction, Rules
from pred_core.pred import load_dynamics
from pred_core.twin import Twin

TWIN = Twin.load(Path(__file__).parents[1] / "config" / "twins" / "plant_rope")
COUNT = TWIN.body.count
TICK = 13_333_333  # [ns] of the poses, 75 Hz
BEGIN = 5_000_000_000  # [ns]
CLOSED = np.array([True])


def hanging() -> np.ndarray:
    """(N, 3) [m] at rest under the gripper at (0, 0, 1); the twin stretches by half a percent under its own weight."""
    place = np.zeros((COUNT, 3))
    place[:, 2] = 1.0 - np.concatenate(([0.0], np.cumsum(TWIN.body.rest_length)))
    return place


def seen(stamp: int, index: np.ndarray | None = None, up: float = 0.0) -> PointFrame:
    """Tracks of some particles."""
    index = np.arange(COUNT) if index is None else index
    place = hanging()[index] + [0.0, 0.0, up]
    return PointFrame(stamp, place, index.astype(np.uint32), np.full(len(index), 0.95, np.float32), None)


def follow(
    follower: Follower,
    ticks: range,
    every: int = 5,
    delay: int = 0,
    index: np.ndarray | None = None,
    tracks: Callable[..., PointFrame] = seen,
) -> list[Prediction]:
    """Poses at every tick, tracks captured at every `every`-th (0: none), `delay` ticks late."""
    given: list[Prediction] = []
    with torch.no_grad():
        for tick in ticks:
            stamp = BEGIN + tick * TICK
            pose = PoseFrame(stamp, np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
            follower.add_pose(pose, CLOSED)
            if every and tick >= delay and (tick - delay) % every == 0:
                follower.add_points(tracks(stamp - delay * TICK, index))
            given += list(follower.advance())
    return given


def follower(rules: Rules | None = None, **config: float) -> Follower:
    return Follower(load_dynamics(TWIN), TWIN.body, {0: 0, 1: 0}, rules or Rules(), config=EstimatorConfig(**config))


def clamped() -> Follower:
    """It knows where in the jaws the held ones sit."""
    return Follower(load_dynamics(TWIN), TWIN.body, {0: 0, 1: 0}, Rules(), levers=dict(TWIN.meta.levers))


def reversed_tracks(stamp: int, index: np.ndarray | None = None) -> PointFrame:
    """The line begun at its far end: particle 0 is where the last one is."""
    right = seen(stamp, index)
    index = right.id.astype(int)
    return PointFrame(stamp, hanging()[::-1][index], right.id, right.confidence, None)


def test_it_starts_and_gives_a_state_at_each_period_and_correction() -> None:
    one = follower()
    given = follow(one, range(90))
    stamps = [p.stamp for p in given]
    assert one.running and one.counts.runs == 1 and stamps == sorted(stamps)
    # One period is 2.5 ticks of the poses; the last state is at most a period older than the last pose.
    assert 0 <= BEGIN + 89 * TICK - stamps[-1] < round(TWIN.meta.period * 1e9) + TICK
    assert np.abs(given[-1].state.position.numpy() - hanging()).max() < 0.008  # 3.5 mm of stretch, and a bounce
    condition = one.condition()
    assert condition.level == "ok" and condition.trouble() == "" and condition.tally.rejected == 0


def test_it_starts_though_a_third_is_never_seen_and_never_all_at_once() -> None:
    """The open loop would wait for two complete frames for ever."""
    one = follower()
    index = np.setdiff1d(np.arange(COUNT), np.arange(10, 20))
    given = follow(one, range(60), index=index)
    assert given and np.abs(given[-1].state.position.numpy() - hanging()).max() < 0.02


def test_late_tracks_lead_to_the_same_state() -> None:
    """The same captures, 107 ms later: once the last of them are in, the states agree, bit for bit."""
    states = {}
    for delay in (0, 8):
        one = follower()
        follow(one, range(191 + delay), delay=delay)  # the last tracks are captured at tick 190
        given = follow(one, range(191 + delay, 240), every=0)
        states[delay] = {p.stamp: p.state.position for p in given}
    stamps = [s for s in states[0] if s in states[8]]
    assert len(stamps) > 10
    for stamp in stamps:
        assert torch.equal(states[0][stamp], states[8][stamp])


def test_without_tracks_it_stops_giving_states_and_goes_on_when_they_are_back() -> None:
    one = follower(stop_after=1.0)
    assert follow(one, range(60))
    given = follow(one, range(60, 100), every=0)
    assert given and "model alone" in one.condition().trouble()
    given = follow(one, range(100, 200), every=0)
    last = max((p.stamp for p in given), default=0)
    # The last tracks were captured at tick 55.
    assert last <= BEGIN + 55 * TICK + 1_000_000_000 and one.condition().level == "stopped"
    assert "no state is given" in one.condition().trouble()
    assert follow(one, range(200, 230)) and one.condition().level == "ok" and one.counts.runs == 1


@pytest.mark.parametrize("nodes", ["live", "reroute"])
def test_a_short_hole_in_the_poses_is_bridged_as_configured_and_a_longer_one_is_a_new_start(nodes: str) -> None:
    """0.4 s without poses and tracks, then one pose: the states of the hole come at once, and the run goes on."""
    path = Path(__file__).parents[1] / "config" / "nodes" / f"{nodes}.yaml"
    given = yaml.safe_load(path.read_text())["predictor"]["ros__parameters"]["max_gap"]
    bridged, plain, longer = follower(Rules(max_gap=given)), follower(), follower(Rules(max_gap=given))
    for one in (bridged, plain, longer):
        follow(one, range(60))
    states = follow(bridged, range(90, 91), every=0)
    period = round(TWIN.meta.period * 1e9)
    assert len(states) >= 30 * TICK // period - 1 and BEGIN + 90 * TICK - states[-1].stamp < period + TICK
    assert (bridged.counts.runs, bridged.counts.gaps) == (1, 0)
    assert np.abs(states[-1].state.position.numpy() - hanging()).max() < 0.008
    assert follow(plain, range(90, 92), every=0) == [] and plain.counts.gaps == 1
    assert follow(longer, range(120, 122), every=0) == [] and longer.counts.gaps == 1, "0.8 s"
    assert follow(longer, range(122, 160)) and longer.counts.runs == 2


def test_frames_older_than_the_history_are_counted() -> None:
    one = follower(history=0.1)
    follow(one, range(60))  # the last tracks were captured at tick 55
    follow(one, range(60, 80), every=0)
    follow(one, range(80, 100), delay=20)  # captured at ticks 60, 65, 70, 75, each 0.27 s late
    assert one.condition().tally.late == 4 and one.counts.runs == 1
    assert "tracks come too late" in one.condition().trouble()


def test_a_loop_starts_a_new_run() -> None:
    one = follower()
    follow(one, range(90))
    given = follow(one, range(60))
    assert one.counts.runs == 2 and one.counts.jumps == 1 and given[-1].stamp <= BEGIN + 60 * TICK


@pytest.mark.parametrize("hidden", [(), (0, 1)], ids=["all seen", "what should be held is not"])
@pytest.mark.parametrize("before", [0, 60], ids=["from the start", "later"])
def test_tracks_with_the_ends_reversed_neither_tear_the_body_nor_lose_the_grip_for_good(
    before: int, hidden: tuple[int, ...]
) -> None:
    """A line that is held at one end cannot have it half a metre away: it is free, until the tracks are right again."""
    one, index = clamped(), np.setdiff1d(np.arange(COUNT), hidden)
    follow(one, range(before))
    wrong = follow(one, range(before, before + 100), index=index, tracks=reversed_tracks)
    assert one.condition().tally.let_go == 2 and "2 particles" in one.condition().trouble()
    right = follow(one, range(before + 100, before + 500))
    for given in (*wrong, *right):
        assert np.ptp(given.state.position.numpy(), axis=0).max() < 0.75, "0.70 m of rope"
    assert right[-1].state.held[:3].tolist() == [0, 0, -1] and "particles" not in one.condition().trouble()
    assert np.abs(right[-1].state.position.numpy() - hanging()).max() < 0.01


@pytest.mark.parametrize(("grown", "faster", "got"), [(100.0, 0.0, "69.9 m across"), (1.0, 4e3, "up to 6.93e.03 m.s")])
def test_a_torn_body_is_not_given(grown: float, faster: float, got: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers refuse one of more than 10 m, and nothing a robot holds moves with 100 m/s: the run starts anew."""
    one = follower()
    follow(one, range(60))
    after = one._estimator.state
    torn = after.replace(position=grown * after.position, velocity=after.velocity + faster)
    monkeypatch.setattr(one._estimator, "step", lambda stamp, grip: torn)
    with pytest.raises(DivergenceError, match=got):
        follow(one, range(60, 70), every=0)
    monkeypatch.undo()
    assert follow(one, range(70, 130)) and one.counts.runs == 2


def test_a_gripper_that_lets_go_and_takes_another_place_is_not_said_to_miss_the_first() -> None:
    """Told to hold the end, it opens, moves to the middle and closes there: what it holds then stays held anew."""
    one = clamped()
    follow(one, range(60))
    middle = hanging()[COUNT // 2]
    with torch.no_grad():
        for tick in range(60, 100):
            height = np.array([[0.0, 0.0, 1.0]]) if tick < 70 else middle[None]
            pose = PoseFrame(BEGIN + tick * TICK, height, np.array([[1.0, 0.0, 0.0, 0.0]]))
            one.add_pose(pose, np.array([tick < 65 or tick > 75]))
            list(one.advance())
    held = one._estimator.state.held
    assert held[:2].tolist() == [-1, -1] and one.condition().missing == 0

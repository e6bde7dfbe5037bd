"""Following the state: laws of the estimator on a hanging rope whose truth the same simulator makes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from pred_core.dynamics import corrected
from pred_core.errors import InputError
from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.estimator import Estimator
from pred_core.estimate.filter import ErrorFilter, Evidence
from pred_core.estimate.measurement import Measurement
from pred_core.estimate.modes import error_modes
from pred_core.estimate.starter import Starter
from pred_core.pred import load_dynamics
from pred_core.twin import Twin
from pred_core.types import Grip, State

TWIN = Twin.load(Path(__file__).parents[1] / "config" / "twins" / "plant_rope")  # 30 particles, 0.7 m, two in the jaws
PERIOD = round(TWIN.meta.period * 1e9)  # [ns] a thirtieth of a second
COUNT = TWIN.body.count
EVERY = 2  # periods between tracks: 15 Hz
SURE = 0.99


@pytest.fixture(scope="module")
def dynamics():
    return load_dynamics(TWIN)


def grip(k: int) -> Grip:
    """At period k: 1 m up, swaying by 5 cm along x with 0.5 Hz."""
    x = 0.05 * np.sin(np.pi * k / 30.0)
    return Grip(torch.tensor([[x, 0.0, 1.0]]).float(), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([True]))


def hanging(push: float = 0.0) -> State:
    """Straight down from the gripper; `push` [m/s] is the speed of the free end along y, less towards the jaws."""
    s = TWIN.body.arc
    position = np.zeros((COUNT, 3))
    position[:, 2] = 1.0 - np.concatenate(([0.0], np.cumsum(TWIN.body.rest_length)))
    velocity = np.zeros((COUNT, 3))
    velocity[:, 1] = push * s
    held = torch.full((COUNT,), -1, dtype=torch.int32)
    held[:2] = 0
    return State(torch.as_tensor(position, dtype=torch.float32), torch.as_tensor(velocity, dtype=torch.float32), held)


def true_run(dynamics, periods: int, push: float = 0.0) -> list[State]:
    """States at periods 0 to `periods`."""
    states = [dynamics.start(hanging(push), grip(0))]
    for k in range(1, periods + 1):
        states.append(dynamics.step(states[-1], grip(k)))
    return states


def tracks(state: State, k: int, index: np.ndarray | None = None, noise: np.ndarray | None = None) -> Measurement:
    """What a sure tracker sees of a state."""
    index = np.arange(COUNT) if index is None else index
    position = state.position.double().numpy()[index] + (0.0 if noise is None else noise)
    return Measurement(k * PERIOD, index, position, np.full(len(index), SURE))


def started(dynamics, config: EstimatorConfig | None = None) -> Estimator:
    """At rest, whatever the truth does."""
    estimator = Estimator(dynamics, TWIN.body, config)
    estimator.start(0, hanging(), grip(0))
    return estimator


def off(estimator: Estimator, truth: State) -> float:
    """[m] mean distance."""
    return float((estimator.state.position - truth.position).norm(dim=-1).mean())


def test_without_tracks_it_is_the_model_bit_for_bit(dynamics) -> None:
    truth = true_run(dynamics, 40)
    estimator = started(dynamics)
    for k in range(1, 41):
        state = estimator.step(k * PERIOD, grip(k))
        assert torch.equal(state.position, truth[k].position) and torch.equal(state.velocity, truth[k].velocity)


def test_perfect_tracks_take_a_wrong_start_to_the_truth(dynamics) -> None:
    """The truth got 0.6 m/s at its free end, the estimate none: alone it is 1 cm off after 2 s."""
    truth = true_run(dynamics, 60, push=0.6)
    alone, followed = started(dynamics), started(dynamics)
    for k in range(1, 61):
        alone.step(k * PERIOD, grip(k))
        followed.step(k * PERIOD, grip(k))
        if k % EVERY == 0:
            followed.correct(tracks(truth[k], k))
    assert off(alone, truth[60]) > 0.008
    assert off(followed, truth[60]) < 0.001
    assert float((followed.state.velocity - truth[60].velocity).norm(dim=-1).mean()) < 0.02
    assert followed.tally.rejected < 0.05 * followed.tally.used


def test_hidden_half_moves_on_with_the_model_and_the_seen_half(dynamics) -> None:
    """The free half is hidden after 0.4 s, for 1.3 s: the estimate stays nearer to it than its last seen place is."""
    truth = true_run(dynamics, 52, push=0.6)
    followed = started(dynamics)
    for k in range(1, 53):
        followed.step(k * PERIOD, grip(k))
        if k % EVERY == 0:
            followed.correct(tracks(truth[k], k, np.arange(COUNT) if k <= 12 else np.arange(COUNT // 2)))
    end = slice(COUNT // 2, None)
    hold = float((truth[12].position - truth[52].position)[end].norm(dim=-1).mean())
    mine = float((followed.state.position - truth[52].position)[end].norm(dim=-1).mean())
    assert hold > 0.04 and mine < 0.1 * hold


def test_a_track_20_cm_off_changes_nothing(dynamics) -> None:
    """Exactly what happens if the particle is not seen."""
    truth = true_run(dynamics, 20, push=0.3)
    results = []
    for wrong in (True, False):
        followed = started(dynamics)
        for k in range(1, 21):
            followed.step(k * PERIOD, grip(k))
            if k % EVERY:
                continue
            noise = np.zeros((COUNT, 3))
            noise[17] = (0.0, 0.2, 0.0)
            index = np.arange(COUNT) if wrong else np.delete(np.arange(COUNT), 17)
            outcome = followed.correct(tracks(truth[k], k, index, noise[index]))
            assert not wrong or outcome.index[~outcome.used].tolist() == [17]
        results.append(followed)
    assert torch.equal(results[0].state.position, results[1].state.position)
    assert results[0].tally.rejected == 10 and results[1].tally.rejected == 0


def test_a_swapped_segment_is_rejected(dynamics) -> None:
    """Ten neighbours in reverse order: the outer eight are 7 cm and more from their places."""
    truth = true_run(dynamics, 30, push=0.3)
    followed = started(dynamics)
    for k in range(1, 31):
        followed.step(k * PERIOD, grip(k))
        if k % EVERY:
            continue
        seen = tracks(truth[k], k)
        if k > 20:
            seen.position[10:20] = seen.position[10:20][::-1].copy()
            outcome = followed.correct(seen)
            assert not set(outcome.index[outcome.used]) & {10, 11, 12, 13, 16, 17, 18, 19}
        else:
            followed.correct(seen)
    assert off(followed, truth[30]) < 0.003 and followed.tally.lost == 0


@pytest.mark.parametrize("late", [1, 3, 5])
def test_tracks_that_arrive_late_give_the_same_state(dynamics, late: int) -> None:
    """Captured between two periods, used `late` periods later: after the last one the states are equal, bit for bit."""
    truth = true_run(dynamics, 40, push=0.4)
    results = []
    for delay in (1, late):
        followed = started(dynamics)
        waiting = []
        for k in range(1, 41):
            followed.step(k * PERIOD, grip(k))
            if k % EVERY == 0 and k <= 30:
                waiting.append((k + delay, dataclasses.replace(tracks(truth[k], k), stamp=k * PERIOD + PERIOD // 3)))
            while waiting and waiting[0][0] <= k:
                followed.correct(waiting.pop(0)[1])
        results.append(followed.state)
    assert torch.equal(results[0].position, results[1].position)
    assert torch.equal(results[0].velocity, results[1].velocity)


def test_tracks_older_than_the_history_or_newer_than_the_state(dynamics) -> None:
    truth = true_run(dynamics, 30)
    followed = started(dynamics)
    for k in range(1, 31):
        followed.step(k * PERIOD, grip(k))
    before = followed.state.position.clone()
    assert followed.correct(tracks(truth[2], 2)).late and followed.tally.late == 1
    assert torch.equal(followed.state.position, before)
    with pytest.raises(InputError, match="out of turn"):
        followed.correct(tracks(truth[30], 31))


def test_a_track_that_is_not_finite_is_refused_and_changes_nothing(dynamics) -> None:
    """It is not measured, or it is an error of the sender: never one of the wrong tracks that mean `lost`."""
    truth = true_run(dynamics, 4)
    refused, plain = started(dynamics), started(dynamics)
    for k in range(1, 5):
        for followed in (refused, plain):
            followed.step(k * PERIOD, grip(k))
        if k % EVERY:
            continue
        for value in (np.nan, np.inf):
            seen = tracks(truth[k], k)
            seen.position[17, 1] = value
            with pytest.raises(InputError, match="track of particle 17 is not finite.*at confidence 0.99"):
                refused.correct(seen)
        for followed in (refused, plain):
            followed.correct(tracks(truth[k], k, np.delete(np.arange(COUNT), 17)))
    assert torch.equal(refused.state.position, plain.state.position)
    assert refused.tally == plain.tally and refused.tally.rejected == 0
    hidden = tracks(truth[4], 4)
    hidden.position[17], hidden.confidence[17] = np.nan, 0.0  # as on the wire: not measured
    assert 17 not in refused.correct(hidden).index


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"index": np.append(np.arange(COUNT - 1), COUNT)}, "each of 0 to 29 once"),
        ({"index": np.append(np.arange(COUNT - 1), 3)}, "29 different ones"),
        ({"index": np.arange(COUNT - 1)}, r"index \(29,\), position \(30, 3\)"),
        ({"confidence": np.append(np.ones(COUNT - 1), np.nan)}, "confidence of particle 29; got nan"),
        ({"confidence": np.append(np.ones(COUNT - 1), 1.5)}, "confidence of particle 29; got 1.5; allowed: 0 to 1"),
    ],
)
def test_what_cannot_be_tracks_of_the_body_is_refused(dynamics, change: dict[str, np.ndarray], words: str) -> None:
    followed = started(dynamics)
    state = followed.step(PERIOD, grip(1))
    with pytest.raises(InputError, match=words):
        followed.correct(dataclasses.replace(tracks(state, 1), **change))


def test_a_correction_does_not_stretch_the_rope(dynamics) -> None:
    """Tracks that lie 2 cm aside, with 2 mm of noise: springs keep their length, and their ends do not part.

    2 mm of noise at two ends 24 mm apart, taken as it is, would be a strain of 10 %.
    """
    followed = started(dynamics)
    for k in range(1, 7):
        followed.step(k * PERIOD, grip(k))
    i, j = TWIN.body.springs.T
    before = followed.state.position
    noise = np.random.default_rng(3).normal(0.0, 0.002, (COUNT, 3)) + [0.0, 0.02, 0.0] * TWIN.body.arc[:, None]
    outcome = followed.correct(tracks(followed.state, 6, noise=noise))
    assert outcome.used.sum() >= 24
    after = followed.state
    moved = (after.position - before).norm(dim=-1)
    assert float(moved[-1]) > 0.01  # it did move
    strain = (after.position[j] - after.position[i]).norm(dim=-1) / (before[j] - before[i]).norm(dim=-1) - 1.0
    assert float(strain.abs().max()) < 0.001
    along = torch.nn.functional.normalize(after.position[j] - after.position[i], dim=-1)
    parting = ((after.velocity[j] - after.velocity[i]) * along).sum(dim=-1)
    assert float(parting.abs().max()) < 0.1 * float(after.velocity.norm(dim=-1).max())


def test_a_corrected_state_goes_on_as_if_it_had_started_there(dynamics) -> None:
    """The bends' damping must not take the correction for a motion: no other step than from a fresh start."""
    state = true_run(dynamics, 10, push=0.5)[-1]
    position, velocity = state.position.clone(), state.velocity.clone()
    position[2:, 1] += 0.02 * torch.arange(COUNT - 2) / COUNT
    fresh = dynamics.start(State(position, velocity, state.held), grip(10))
    wanted = dynamics.step(fresh, grip(11))
    got = dynamics.step(corrected(dynamics, state, position, velocity), grip(11))
    naive = dynamics.step(state.replace(position=position, velocity=velocity), grip(11))
    # Offsets in the gripper are found anew by `start`: they differ by rounding.
    assert float((got.velocity - wanted.velocity).abs().max()) < 1e-4
    assert float((naive.velocity - wanted.velocity).abs().max()) > 1e-3
    clock = corrected(dynamics, state, position, velocity).memory
    assert float(clock["time"] + clock["steps"] * dynamics.period) == pytest.approx(10 * dynamics.period, rel=1e-6)


def test_lost_state_starts_anew_and_says_so(dynamics) -> None:
    """The rope suddenly hangs 45 degrees aside: after half a second of contradiction the tracks are believed."""
    truth = true_run(dynamics, 60)
    followed = started(dynamics)
    depth = np.concatenate((np.zeros(2), np.cumsum(TWIN.body.rest_length[1:])))[:, None]
    aside = depth * [0.0, np.sqrt(0.5), 1.0 - np.sqrt(0.5)]
    anew = []
    for k in range(1, 61):
        followed.step(k * PERIOD, grip(k))
        if k % EVERY == 0:
            outcome = followed.correct(tracks(truth[k], k, noise=aside if k > 20 else 0.0 * aside))
            anew += [k] if outcome.anew else []
    # Contradicted since period 22; 0.5 s is 15 periods; the next tracks come at period 38.
    assert anew[:1] == [38] and followed.tally.lost == len(anew)
    assert followed.tally.let_go == 0  # the two in the jaws were seen there


def test_rope_that_left_the_jaws_is_let_go_at_the_new_start(dynamics) -> None:
    truth = true_run(dynamics, 50)
    followed = started(dynamics)
    for k in range(1, 51):
        followed.step(k * PERIOD, grip(k))
        if k % EVERY == 0:
            fallen = np.tile([0.0, 0.0, -0.3 if k > 10 else 0.0], (COUNT, 1))
            followed.correct(tracks(truth[k], k, noise=fallen))
    assert followed.tally.let_go == 2 and int(followed.state.held.max()) == -1


def test_guesses_of_hidden_particles_and_held_ones_are_not_used(dynamics) -> None:
    truth = true_run(dynamics, 2)
    followed = started(dynamics)
    for k in (1, 2):
        followed.step(k * PERIOD, grip(k))
    seen = tracks(truth[2], 2)
    seen.confidence[20:] = 0.45  # the tracker halves the confidence of what it does not see
    assert followed.correct(seen).index.tolist() == list(range(2, 20))


def test_blind_and_stopped_after_their_times(dynamics) -> None:
    truth = true_run(dynamics, 10)
    followed = started(dynamics)
    for k in range(1, 11):
        followed.step(k * PERIOD, grip(k))
    followed.correct(tracks(truth[10], 10))
    base = 10 * PERIOD
    levels = [followed.health.level(base + round(s * 1e9)) for s in (0.4, 0.6, 1.9, 2.1)]
    assert levels == ["ok", "blind", "blind", "stopped"]


def test_start_from_tracks_with_holes_and_a_wrong_one() -> None:
    """A bent rope, a fifth of it never seen and one track 10 cm off: all within 1 cm, the unseen end too."""
    angle = 1.5 * TWIN.body.arc  # a circular arc of 0.7 m
    place = np.stack((0.467 * np.sin(angle), 0.467 * (1 - np.cos(angle)), np.full(COUNT, 0.5)), axis=1)
    starter = Starter(TWIN.body, EstimatorConfig())
    generator = np.random.default_rng(5)
    index = np.setdiff1d(np.arange(COUNT), [8, 9, 10, 22, 23, 29])
    for k in range(4):
        seen = place[index] + generator.normal(0.0, 0.001, (len(index), 3)) + [0.2 * k / 15.0, 0.0, 0.0]
        seen[12] += (0.0, 0.0, 0.1)
        assert starter.find() is None or k > 1
        starter.add(Measurement(k * 66_000_000, index, seen, np.ones(len(index))))
    found = starter.find()
    assert found is not None and np.isnan(found.track[[8, 9, 10, 22, 23, 29, index[12]]]).all()
    assert np.linalg.norm(found.position - place - [0.04, 0.0, 0.0], axis=1).max() < 0.010
    assert np.linalg.norm(found.velocity - [0.2, 0.0, 0.0], axis=1).max() < 0.05


def test_the_filter_is_kalmans() -> None:
    """Its update in modes equals the textbook's in particles, and `apart` leaving one out and predicting it."""
    held = np.zeros(COUNT, bool)
    held[:2] = True
    modes = error_modes(TWIN.body, held, 0.08, 64)
    assert np.allclose(modes.shape.T @ modes.shape, np.eye(len(modes.variance)), atol=1e-9)
    assert not modes.shape[:2].any() and np.all(np.diff(modes.variance) <= 0.0)
    errors = ErrorFilter(modes, EstimatorConfig())
    errors.predict(0.1)
    m = len(modes.variance)
    full = np.kron(np.eye(2), modes.shape) @ errors._covariance @ np.kron(np.eye(2), modes.shape).T
    assert np.allclose(np.diag(full)[:COUNT], errors.variance())
    index = np.array([4, 9, 11, 25])
    evidence = Evidence(index, np.random.default_rng(0).normal(0.0, 0.01, (4, 3)), np.array([1e-6, 4e-6, 1e-6, 9e-6]))
    s = full[np.ix_(index, index)] + np.diag(evidence.variance)
    rest = [0, 2, 3]
    guess = s[1, rest] @ np.linalg.solve(s[np.ix_(rest, rest)], evidence.innovation[rest])
    spread = s[1, 1] - s[1, rest] @ np.linalg.solve(s[np.ix_(rest, rest)], s[rest, 1])
    assert errors.apart(evidence)[1] == pytest.approx(((evidence.innovation[1] - guess) ** 2).sum() / spread, rel=1e-6)
    wanted = full[:, index] @ np.linalg.solve(s, evidence.innovation)
    change = errors.update(evidence)
    assert np.allclose(change.position, wanted[:COUNT], atol=1e-9) and np.allclose(change.velocity, wanted[COUNT:])
    assert errors._covariance.shape == (2 * m, 2 * m) and errors.variance()[9] < evidence.variance[1]

"""Baselines: laws on small motions, and the published scores on the measured cables."""

import numpy as np
import pytest
import torch
from evaluation_cases import episode_of, swinging_cable

from pred_core import metrics
from pred_core.bag.measured import find_measured
from pred_core.baselines import (
    BlendedEnds,
    ConstantVelocity,
    LastResidual,
    Persistence,
    fit_static_regression,
)
from pred_core.baselines.holding import attach, carried_position
from pred_core.dynamics import Dynamics
from pred_core.errors import DatasetError, InputError
from pred_core.evaluate.protocol import predict
from pred_core.frames import quaternion_from_rotation_vector
from pred_core.types import Grip, State, stack_grips, stack_states


def all_baselines(episodes):
    n = episodes[0].position.shape[1]
    return [
        Persistence(0.01),
        ConstantVelocity(0.01),
        BlendedEnds.by_order(0.01, n),
        fit_static_regression(episodes),
        LastResidual(ConstantVelocity(0.01)),
    ]


def rolled(dynamics, episode):
    state = dynamics.start(episode.state_at(1), episode.grips.at(1))
    return dynamics.rollout(state, episode.grips.span(2, len(episode.stamps)))


def test_held_particles_follow_the_gripper_in_every_baseline():
    episodes = [swinging_cable(s) for s in range(4)]
    for dynamics in all_baselines(episodes):
        assert isinstance(dynamics, Dynamics)
        out = rolled(dynamics, episodes[0])
        # float32 coordinates below 1 m: 1e-6 m.
        assert np.allclose(out[:, [0, -1]].numpy(), episodes[0].position[2:, [0, -1]], atol=1e-6), type(dynamics)


def test_batch_equals_loop():
    episodes = [swinging_cable(s) for s in range(3)]
    for dynamics in all_baselines(episodes):
        state = dynamics.start(
            stack_states([e.state_at(1) for e in episodes]), stack_grips([e.grips.at(1) for e in episodes])
        )
        batch = dynamics.rollout(state, stack_grips([e.grips.span(2, 60) for e in episodes], dim=1))
        for i, episode in enumerate(episodes):
            assert torch.allclose(batch[:, i], rolled(dynamics, episode), atol=1e-6), type(dynamics)


def test_persistence_keeps_free_particles_and_constant_velocity_moves_them_by_vt():
    episode = swinging_cable(0)
    still = rolled(Persistence(0.01), episode)
    assert torch.equal(still[-1, 1:-1], episode.state_at(1).position[1:-1])
    moving = rolled(ConstantVelocity(0.01), episode)
    state = episode.state_at(1)
    expected = state.position + 58 * 0.01 * state.velocity
    assert torch.allclose(moving[-1, 1:-1], expected[1:-1], atol=1e-5)


def test_a_particle_held_off_centre_turns_with_the_gripper():
    # 0.1 m in front of a gripper that turns by 90 degrees about z: it ends 0.1 m to its left.
    state = State(torch.tensor([[0.1, 0.0, 0.0]]), torch.zeros(1, 3), torch.zeros(1, dtype=torch.int32))
    closed = torch.ones(1, dtype=torch.bool)
    first = Grip(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), closed)
    turn = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, np.pi / 2]]))
    second = Grip(torch.tensor([[0.0, 0.0, 1.0]]), turn, closed)
    moved = carried_position(attach(state, first), second)
    assert torch.allclose(moved, torch.tensor([[0.0, 0.1, 1.0]]), atol=1e-6)
    released = Grip(second.position, second.rotation, ~closed)
    dynamics = Persistence(0.01)
    assert torch.equal(dynamics.step(dynamics.start(state, first), released).position, state.position)


def test_blended_ends_by_hand():
    # Ends move by +1 (left, x) and +2 (right, z); the quarter point moves by 0.75 and 0.5.
    line = np.zeros((3, 5, 3))
    line[:, :, 0] = np.linspace(0, 1, 5)
    line[2, 0, 0] += 1.0
    line[2, 4, 2] += 2.0
    out = rolled(BlendedEnds.by_order(0.01, 5), episode_of(line, [0, -1, -1, -1, 1]))
    assert out[0, 1].tolist() == pytest.approx([0.25 + 0.75, 0.0, 0.5], abs=1e-6)
    with pytest.raises(InputError, match="no particle is held"):
        BlendedEnds.by_order(0.01, 5).start(episode_of(line, [-1] * 5).state_at(1))


def test_static_regression_recovers_a_quadratic_law():
    # The shape is a quadratic function of the ends up to a swing of 10 mm x 1/4 out of plane.
    train = [swinging_cable(s, split="train", recording=s) for s in range(40)]
    out = rolled(fit_static_regression(train), swinging_cable(99)).numpy()
    error = np.abs(out - swinging_cable(99).position[2:])
    assert error[..., [0, 2]].max() < 1e-3, "what the ends decide is found"
    assert error[..., 1].max() < 6e-3, "and what they do not decide is missed by at most its amplitude"


def test_static_regression_refuses_what_it_cannot_fit():
    with pytest.raises(DatasetError, match="too few"):
        fit_static_regression([swinging_cable(0)])
    fitted = fit_static_regression([swinging_cable(0), swinging_cable(1)])
    other = episode_of(swinging_cable(0).position, [0, 1, -1, -1, -1, -1])
    with pytest.raises(InputError, match="other particles are held"):
        fitted.start(other.state_at(1), other.grips.at(1))


def test_last_residual_repairs_a_constant_residual_velocity_exactly():
    # Truth falls at g; the base keeps the velocity. Residual velocity of one step is g dt, so feeding it back
    # at every step makes the velocity grow as it should: the error after n steps is that of the first two frames.
    dt, g, t = 0.01, -9.81, np.arange(40) * 0.01
    position = np.zeros((40, 2, 3))
    position[:, 1, 2] = 1.0 + 0.5 * g * t**2
    episode = episode_of(position, [0, -1])

    class Inertial(Persistence):
        def step(self, state: State, grip: Grip) -> State:
            moved = state.position + self.period * state.velocity
            return state.replace(position=torch.where((state.held >= 0)[..., None], state.position, moved))

    dynamics = LastResidual(Inertial(dt))
    state, predicted = dynamics.start_after(
        episode.state_at(1), episode.grips.at(1), episode.state_at(2), episode.grips.at(2)
    )
    assert predicted[1, 2].item() == pytest.approx(2 * position[1, 1, 2] - position[0, 1, 2], abs=1e-6)
    assert state.memory["last_residual"][1, 2].item() == pytest.approx(g * dt, abs=2e-5)
    out = dynamics.rollout(state, episode.grips.span(3, 40))
    # float32 rounding of 1e-7 m is divided by dt and multiplied by 37^2 / 2 steps: 7e-4 m at worst.
    assert np.allclose(out[:, 1, 2].numpy(), position[3:, 1, 2], atol=7e-4)
    without = dynamics.start(episode.state_at(1), episode.grips.at(1))
    assert without.memory["last_residual"].abs().max().item() == 0.0


# Mean absolute error per coordinate on the published test split [1e-2 m]: the numbers the field's tables carry.
PUBLISHED = {
    "deform_dlo1": {"persistence": 5.67, "blended-ends": 3.41, "static-regression": 1.80, "grouped": 2.29},
    "deform_dlo2": {"persistence": 5.29, "blended-ends": 2.94, "static-regression": 1.45, "grouped": 2.06},
}


def measured_cable(name):
    path = find_measured(name)
    if path is None or path.suffix != ".npz":
        pytest.skip(f"measured data '{name}' not found (set PRED_DATA)")
    with np.load(path, allow_pickle=False) as data:
        position, split, recording = data["positions"], data["split"], data["recording_id"]
    n = position.shape[2]
    held = [0, 1] + [-1] * (n - 4) + [2, 3]
    return [
        episode_of(p.astype(np.float64), held, name=f"ep{i:03d}", split=str(s), recording=int(r))
        for i, (p, s, r) in enumerate(zip(position, split, recording, strict=True))
    ]


def score(dynamics, episodes):
    pairs = zip(predict(dynamics, episodes), episodes, strict=True)
    return 100 * float(np.mean([np.mean(metrics.coordinate_l1(p, e.position[2:])) for p, e in pairs]))


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_published_scores_on_the_measured_cables(name):
    episodes = measured_cable(name)
    train, test = ([e for e in episodes if (e.split == "train") == is_train] for is_train in (True, False))
    published = PUBLISHED[name]
    # Nothing to choose in these two: they agree to the digit printed.
    assert score(Persistence(0.01), test) == pytest.approx(published["persistence"], abs=0.006)
    blended = BlendedEnds.by_order(0.01, len(test[0].held))
    assert score(blended, test) == pytest.approx(published["blended-ends"], abs=0.006)
    # How the ridge is chosen is not published; ours may differ by 0.1 and must not be a weaker baseline.
    static = score(fit_static_regression(train), test)
    assert published["static-regression"] - 0.15 < static < published["static-regression"] + 0.03


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_static_regression_is_worse_when_recordings_are_not_split(name):
    # The published folds are not known; the score without leakage must be near or below the published one
    # and worse than on the leaking split of the same data.
    episodes = measured_cable(name)
    recordings = sorted({e.recording for e in episodes})
    scores = []
    for fold in range(5):
        test = [e for e in episodes if e.recording in recordings[fold::5]]
        fitted = fit_static_regression([e for e in episodes if e.recording not in recordings[fold::5]])
        scores += [score(fitted, test)] * len(test)
    grouped = float(np.mean(scores))
    assert PUBLISHED[name]["static-regression"] < grouped < PUBLISHED[name]["grouped"] + 0.05

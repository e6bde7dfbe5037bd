"""PReD as a Dynamics: the paper's update, held particles, memory that forks."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from residual_case import PERIOD, Falling, line_body, random_state, still_grip

from pred_core.dynamics import Dynamics, corrected
from pred_core.errors import DivergenceError, InputError
from pred_core.pred import COUNT, FRAME, PAST_POSITION, PAST_VELOCITY, WINDOW, PReD, with_residual
from pred_core.residual import ResidualConfig, build_network
from pred_core.types import Grip, State, stack_states

SMALL = ResidualConfig(feature=16, hidden=16, embedding=16, feedforward=32, encoder_feedforward=32, encoder_layers=2)


def model(seed: int = 0, untrained: bool = False, config: ResidualConfig = SMALL) -> PReD:
    network = build_network(config, seed)
    generator = torch.Generator().manual_seed(seed)
    if not untrained:
        with torch.no_grad():
            for parameter in network.parameters():
                parameter += 0.2 * torch.randn(parameter.shape, generator=generator)
    return PReD(Falling(), network, line_body())


def test_is_a_dynamics() -> None:
    assert isinstance(model(), Dynamics)


def test_untrained_pred_is_its_base_bit_for_bit() -> None:
    start = random_state(torch.Generator().manual_seed(0), 2)
    grips = still_grip(5, 2)
    base = Falling()
    pred = model(untrained=True)
    expected = base.rollout(base.start(start, grips.at(0)), grips)
    assert pred.rollout(pred.start(start, grips.at(0)), grips).equal(expected)


def test_update_is_the_papers_and_held_particles_get_nothing() -> None:
    pred = model()
    state = pred.start(random_state(torch.Generator().manual_seed(0), 4), still_grip(4))
    for _ in range(3):
        with torch.no_grad():
            step = pred.advance(state, still_grip(4))
        assert step.residual[:, 0].eq(0).all() and step.residual[:, 1:].abs().min() > 0
        assert torch.allclose(step.state.velocity, step.predicted.velocity + step.residual)
        assert torch.allclose(step.state.position, step.predicted.position + step.residual * PERIOD)
        state = step.state


def test_batch_equals_loop_and_rollout_equals_steps() -> None:
    pred = model()
    generator = torch.Generator().manual_seed(1)
    singles = [random_state(generator) for _ in range(3)]
    grips = still_grip(8, 3)
    whole = pred.rollout(pred.start(stack_states(singles), grips.at(0)), grips)
    for b, single in enumerate(singles):
        state = pred.start(single, still_grip())
        for t in range(8):
            state = pred.step(state, still_grip())
            assert torch.allclose(state.position, whole[t, b], atol=1e-5)


def test_memory_forks_with_the_state() -> None:
    pred = model()
    trunk = pred.start(random_state(torch.Generator().manual_seed(2)), still_grip())
    for _ in range(3):
        trunk = pred.step(trunk, still_grip())
    before = {k: v.clone() for k, v in trunk.memory.items()}
    first = pred.step(trunk, still_grip())
    pred.step(pred.step(first, still_grip()), still_grip())  # another branch must leave no trace
    again = pred.step(trunk, still_grip())
    assert first.position.equal(again.position)
    assert all(trunk.memory[k].equal(v) for k, v in before.items())
    fresh = pred.start(State(trunk.position, trunk.velocity, trunk.held), still_grip())
    assert not pred.step(fresh, still_grip()).position.equal(first.position)  # the memory matters
    forks = pred.step(stack_states([trunk, trunk]), still_grip(2))
    assert torch.allclose(forks.position[1], first.position, atol=1e-5)


def test_network_frame_turns_inputs_and_outputs() -> None:
    # Seen at azimuth 180 degrees about z, (x, y, z) is (-x, -y, z): turning the world instead gives the same.
    pred = model()
    state = random_state(torch.Generator().manual_seed(3))
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    turned = dataclasses.replace(state, position=state.position @ half_turn, velocity=state.velocity @ half_turn)
    plain = pred.start(state, still_grip())
    seen = plain.replace(memory={**plain.memory, FRAME: half_turn})
    other = pred.start(turned, still_grip())
    for _ in range(3):
        seen, other = pred.step(seen, still_grip()), pred.step(other, still_grip())
    assert torch.allclose(seen.position, other.position @ half_turn, atol=1e-5)
    assert not torch.allclose(seen.position, pred.rollout(plain, still_grip(3))[-1], atol=1e-5)


def test_a_correction_is_no_motion_to_the_network() -> None:
    """All measured 5 cm aside, which a network that sees no places cannot know: its residual is what it was. With the
    positions replaced and the frame before left where it was, it would see a jump of 2.5 m/s."""
    pred = model(config=dataclasses.replace(SMALL, coordinates="centered"))
    state = pred.start(random_state(torch.Generator().manual_seed(4), held_first=False), still_grip())
    for _ in range(3):
        state = pred.step(state, still_grip())
    aside = state.position + torch.tensor([0.05, 0.0, 0.0])
    with torch.no_grad():
        wanted = pred.advance(state, still_grip()).residual
        got = pred.advance(corrected(pred, state, aside, state.velocity), still_grip()).residual
        jumped = pred.advance(state.replace(position=aside), still_grip()).residual
    assert torch.allclose(got, wanted, atol=1e-5)  # float32 of places over a period of 0.02 s
    assert (jumped - wanted).abs().max() > 1e-2


def test_a_correction_of_velocity_and_a_base_with_memory() -> None:
    """Both parts of the frame before move along, and the base makes its own memory anew from the corrected state."""

    class Remembering(Falling):
        def corrected(self, state: State, position: torch.Tensor, velocity: torch.Tensor) -> State:
            memory = {**state.memory, "times": torch.tensor(1)}
            return state.replace(position=position, velocity=velocity, memory=memory)

    plain = model()
    pred = PReD(Remembering(), plain.network, line_body())
    state = pred.step(pred.start(random_state(torch.Generator().manual_seed(5), 2), still_grip(2)), still_grip(2))
    shift = 0.01 * torch.randn(state.position.shape, generator=torch.Generator().manual_seed(6))
    moved = corrected(pred, state, state.position + shift, state.velocity - 10.0 * shift)
    assert torch.equal(moved.position, state.position + shift) and torch.equal(moved.held, state.held)
    for now, before in (("position", PAST_POSITION), ("velocity", PAST_VELOCITY)):
        difference = getattr(state, now) - state.memory[before]
        assert torch.allclose(getattr(moved, now) - moved.memory[before], difference, atol=1e-6)
    assert set(moved.memory) == {*state.memory, "base/times"}
    assert all(moved.memory[k] is state.memory[k] for k in (WINDOW, COUNT))


def test_bad_states_are_refused() -> None:
    pred = model()
    with pytest.raises(InputError, match="7 particles"):
        pred.start(random_state(torch.Generator(), count=7), still_grip())
    with pytest.raises(InputError, match="start"):
        pred.step(random_state(torch.Generator()), still_grip())


def test_divergence_names_the_step() -> None:
    pred = model()
    state = pred.start(random_state(torch.Generator().manual_seed(0)), still_grip())
    grips = still_grip(4)
    grips.position[2] = float("nan")
    with pytest.raises(DivergenceError, match="step 3"):
        pred.rollout(state, grips)


def test_twin_without_residual_stays_the_base() -> None:
    from pred_core.twin import Twin, TwinMeta
    from pred_core.types import Physics

    base = Falling()
    twin = Twin(TwinMeta(), line_body(), Physics())
    assert with_residual(base, twin) is base
    loaded = with_residual(base, twin.replace(residual=model().network.weights()))
    assert isinstance(loaded, PReD)
    state = random_state(torch.Generator().manual_seed(0))
    expected = model().step(model().start(state, still_grip()), still_grip())
    assert loaded.step(loaded.start(state, still_grip()), still_grip()).position.equal(expected.position)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_cuda_equals_cpu() -> None:
    cpu, gpu = model(), PReD(Falling(), model().network.cuda(), line_body())
    start = random_state(torch.Generator().manual_seed(0), 3)
    state, grip = cpu.start(start, still_grip(3)), still_grip(3)
    there = Grip(grip.position.cuda(), grip.rotation.cuda(), grip.closed.cuda())
    other = gpu.start(State(start.position.cuda(), start.velocity.cuda(), start.held.cuda()), there)
    for _ in range(7):
        state, other = cpu.step(state, grip), gpu.step(other, there)
    assert torch.allclose(state.position, other.position.cpu(), atol=1e-4)  # float32 sums in another order

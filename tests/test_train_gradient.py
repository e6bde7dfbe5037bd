"""Gradients past the backbone, against a Jacobian known by hand."""

from __future__ import annotations

import torch
from residual_case import PERIOD, Falling, random_state, still_grip

from pred_core.train.gradient import StepGradient, ballistic, transposed_jacobian


def test_differences_are_the_jacobian_of_drag() -> None:
    # v' = (1 - b dt) v + g dt, x' = x + dt v', so J^T (gx, gv) = (gx, (1 - b dt)(gv + dt gx)); b = 5/s: factor 0.9.
    base, grip = Falling(drag=5.0), still_grip(3)
    state = base.start(random_state(torch.Generator().manual_seed(0), 3), grip)
    generator = torch.Generator().manual_seed(1)
    to_position, to_velocity = (torch.randn(3, 6, 3, generator=generator) for _ in range(2))
    got_position, got_velocity = transposed_jacobian(base, state, grip, to_position, to_velocity)
    free = slice(1, None)
    # Float32 positions of 0.3 m resolve 3e-8, over 2 bumps of 1e-4, summed over 36 numbers of size 1: about 1e-2.
    assert torch.allclose(got_position[:, free], to_position[:, free], atol=2e-2)
    expected = 0.9 * (to_velocity + PERIOD * to_position)
    assert torch.allclose(got_velocity[:, free], expected[:, free], atol=2e-3)
    assert got_position[:, 0].eq(0).all() and got_velocity[:, 0].eq(0).all()  # held: the gripper decides


def test_zeros_carry_the_gradient() -> None:
    base, grip = Falling(drag=5.0), still_grip(1)
    state = base.start(random_state(torch.Generator().manual_seed(0), 1), grip)
    position, velocity = (v.clone().requires_grad_() for v in (state.position, state.velocity))
    zeros = StepGradient.apply(position, velocity, base, state, grip)
    assert zeros[0].eq(0).all() and zeros[1].eq(0).all()
    (zeros[0].sum() + 2.0 * zeros[1].sum()).backward()
    assert velocity.grad is not None and position.grad is not None
    assert torch.allclose(velocity.grad[:, 1:], torch.full((1, 5, 3), 0.9 * (2.0 + PERIOD)), atol=2e-3)
    live = state.replace(position=position.detach().requires_grad_(), velocity=velocity.detach().requires_grad_())
    flight = ballistic(live, PERIOD)
    (flight[0].sum() + 2.0 * flight[1].sum()).backward()
    assert live.velocity.grad is not None
    assert torch.allclose(live.velocity.grad, torch.full((1, 6, 3), 2.0 + PERIOD))

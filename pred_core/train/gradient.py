"""How an error at a later step reaches an earlier correction, past a backbone that has no gradient.

ballistic: free flight, x' = x + v dt, v' = v. Costs nothing; right where forces change slowly within a window.
differences: the backbone's own one-step Jacobian by finite differences, 6 worlds a free particle, advanced as
one batch. Right for stiff objects; for objects of some tens of particles. Memory passes no gradient.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pred_core.dynamics import Dynamics
from pred_core.types import Grip, State

POSITION_STEP = 1e-4  # [m] float32 positions of a metre resolve 1e-7: a thousandth of it
VELOCITY_STEP = 1e-2  # [m/s] moves a particle by 1e-4 m in 10 ms


def transposed_jacobian(
    base: Dynamics, state: State, grip: Grip, to_position: Tensor, to_velocity: Tensor
) -> tuple[Tensor, Tensor]:
    """J^T g of one step of `base` at `state` (B, N, 3), g = (to_position, to_velocity) (B, N, 3) each.

    Central differences in every coordinate of the particles that are free in any of the B worlds.
    """
    batch, count = state.position.shape[:2]
    free = (state.held < 0).any(dim=0).nonzero()[:, 0]
    number = 3 * len(free)
    coordinates = (3 * free[:, None] + torch.arange(3, device=free.device)).flatten()
    bump = torch.zeros(number, 3 * count, device=state.position.device)
    bump[torch.arange(number, device=free.device), coordinates] = 1.0
    bump = bump.view(number, 1, count, 3)
    nothing = torch.zeros_like(bump)
    position = torch.cat((bump, -bump, nothing, nothing)) * POSITION_STEP + state.position
    velocity = torch.cat((nothing, nothing, bump, -bump)) * VELOCITY_STEP + state.velocity
    worlds = len(position)

    def spread(value: Tensor) -> Tensor:
        return value.expand(worlds, *value.shape)

    memory = {key: spread(value) for key, value in state.memory.items()}
    many = Grip(spread(grip.position), spread(grip.rotation), spread(grip.closed))
    after = base.step(State(position, velocity, spread(state.held), memory), many)
    score = (after.position * to_position).sum(dim=(2, 3)) + (after.velocity * to_velocity).sum(dim=(2, 3))
    up_x, down_x, up_v, down_v = score.view(4, number, batch)
    gradients = []
    for up, down, size in ((up_x, down_x, POSITION_STEP), (up_v, down_v, VELOCITY_STEP)):
        flat = torch.zeros(batch, 3 * count, device=state.position.device)
        flat[:, coordinates] = ((up - down) / (2.0 * size)).T
        gradients.append(torch.where((state.held < 0).unsqueeze(-1), flat.view(batch, count, 3), 0.0))
    return gradients[0], gradients[1]


class StepGradient(torch.autograd.Function):
    """Zeros (B, N, 3), twice, that carry the gradient of one backbone step; add them to its prediction."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, position: Tensor, velocity: Tensor, base: Dynamics, state: State, grip: Grip
    ) -> tuple[Tensor, Tensor]:
        """`state` is the detached backbone state at (position, velocity); `grip` ends the step."""
        ctx.step = (base, state, grip)
        return torch.zeros_like(position), torch.zeros_like(velocity)

    @staticmethod
    def backward(  # type: ignore[override]
        ctx: Any, to_position: Tensor, to_velocity: Tensor
    ) -> tuple[Tensor, Tensor, None, None, None]:
        """Gradients with respect to the state before the step."""
        base, state, grip = ctx.step
        position, velocity = transposed_jacobian(base, state, grip, to_position, to_velocity)
        return position, velocity, None, None, None


def ballistic(before: State, period: float) -> tuple[Tensor, Tensor]:
    """The zeros of `StepGradient`, with the gradient of free flight."""
    velocity = before.velocity - before.velocity.detach()
    return before.position - before.position.detach() + period * velocity, velocity

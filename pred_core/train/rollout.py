"""Loss and error of a PReD over a batch of windows, rolled out on its own predictions (paper III-B)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from pred_core.errors import DivergenceError
from pred_core.frames import quaternion_from_rotation_vector, quaternion_to_matrix
from pred_core.pred import FRAME, Advance, PReD
from pred_core.residual import binding_share
from pred_core.train.config import TrainingConfig
from pred_core.train.gradient import StepGradient, ballistic
from pred_core.train.recordings import Batch
from pred_core.types import Grip, State

MILLIMETRE = 1e3


@dataclass(frozen=True)
class Outcome:
    """What a rollout of a batch gave."""

    loss: Tensor  # scalar [mm^2] or [mm], with the penalty
    error: float  # [mm] mean absolute error per coordinate
    binding: float  # share of residual components beyond 0.95 of the cap
    state: State  # after the last step, without gradient


def random_azimuth(gravity: Sequence[float], number: int, generator: torch.Generator) -> Tensor:
    """(number, 3, 3) rotations about gravity by uniform angles; about z where there is no gravity."""
    axis = torch.tensor(gravity, dtype=torch.float32)
    axis = axis / axis.norm() if float(axis.norm()) > 0 else torch.tensor((0.0, 0.0, 1.0))
    angle = 2.0 * math.pi * torch.rand(number, 1, generator=generator)
    return quaternion_to_matrix(quaternion_from_rotation_vector(angle * axis))


def disturbed(start: State, config: TrainingConfig, generator: torch.Generator) -> State:
    """The start with white noise on free particles, if the configuration asks for it."""
    free = (start.held < 0).unsqueeze(-1)
    for name, sigma in (("position", config.noise_position), ("velocity", config.noise_velocity)):
        if sigma > 0.0:
            value: Tensor = getattr(start, name)
            noise = sigma * torch.randn(value.shape, generator=generator).to(value.device)
            start = start.replace(**{name: value + torch.where(free, noise, 0.0)})
    return start


def training_start(
    model: PReD, batch: Batch, config: TrainingConfig, gravity: Sequence[float], generator: torch.Generator
) -> State:
    """The batch's start as training sees it: with noise and azimuth, if the configuration asks for them."""
    state = model.start(disturbed(batch.start, config, generator), batch.start_grip)
    if config.azimuth:
        turn = random_azimuth(gravity, len(state.position), generator).to(state.position.device)
        state = state.replace(memory={**state.memory, FRAME: turn})
    return state


def training_rollout(model: PReD, state: State, batch: Batch, config: TrainingConfig) -> Outcome:
    """Loss over K steps of own predictions from `state`: (X_sim + dV dt - X_true)^2, the simulator detached.

    This is the paper's loss on dV dt against X_true - X_sim, in mm.
    """
    total, penalty = batch.target.new_zeros(()), batch.target.new_zeros(())
    absolute, binding = batch.target.new_zeros(()), batch.target.new_zeros(())
    count = 3 * batch.seen.sum().clamp_min(1)
    steps = len(batch.target)
    for k in range(steps):
        step = model.advance(state, batch.grips.at(k))
        arrived = _arrived(model, state, step, batch.grips.at(k), config.gradient)
        error = (arrived.position - batch.target[k]) * batch.seen[k].unsqueeze(-1) * MILLIMETRE
        total = total + _loss(error, config)
        penalty = penalty + (step.residual / model.network.config.cap).square().mean()
        absolute += error.detach().abs().sum()
        binding += binding_share(step.residual.detach(), step.state.held < 0, model.network.config.cap)
        state = _detached(arrived) if config.gradient == "detached" else arrived
    loss = total / count + config.penalty * penalty / steps
    return Outcome(loss, float(absolute / count), float(binding / steps), _detached(state))


@torch.no_grad()
def held_out_error(model: PReD, batch: Batch) -> Outcome:
    """Open-loop error of a batch. Raises: DivergenceError if a position leaves the finite numbers."""
    state = model.start(batch.start, batch.start_grip)
    absolute, binding = batch.target.new_zeros(()), batch.target.new_zeros(())
    for k in range(len(batch.target)):
        step = model.advance(state, batch.grips.at(k))
        state = step.state
        absolute += ((state.position - batch.target[k]) * batch.seen[k].unsqueeze(-1)).abs().sum() * MILLIMETRE
        binding += binding_share(step.residual, state.held < 0, model.network.config.cap)
    error = absolute / (3 * batch.seen.sum()).clamp_min(1)
    if not bool(torch.isfinite(error)):
        raise DivergenceError("a held-out rollout left the finite numbers", next_step="Lower --cap or --learning-rate")
    return Outcome(error, float(error), float(binding / len(batch.target)), state)


def _loss(error: Tensor, config: TrainingConfig) -> Tensor:
    """Sum over an error [mm] of any shape; `smooth` is square / (2 beta) within beta and has slope 1 beyond."""
    if config.loss == "square":
        return error.square().sum()
    if config.loss == "absolute":
        return error.abs().sum()
    return functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="sum", beta=config.beta)


def _detached(state: State) -> State:
    """The state without the history of its gradient, its memory included."""
    memory = {key: value.detach() for key, value in state.memory.items()}
    return State(state.position.detach(), state.velocity.detach(), state.held, memory)


def _arrived(model: PReD, before: State, step: Advance, grip: Grip, gradient: str) -> State:
    """The step's state, equal in value, with the gradient the configuration asks for."""
    if gradient == "detached":
        return step.state
    if gradient == "ballistic":
        zeros = ballistic(before, model.period)
    else:
        zeros = StepGradient.apply(before.position, before.velocity, model.base, model.base_state(before), grip)
    return step.state.replace(position=step.state.position + zeros[0], velocity=step.state.velocity + zeros[1])

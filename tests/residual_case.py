"""A case small enough to know by hand: a falling line of particles with air drag, and a base that lacks the drag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.dynamics import rollout_by_steps
from pred_core.types import Body, Episode, Grip, ObjectInfo, State, Tracks

PERIOD = 0.02  # [s]
GRAVITY = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class Falling:
    """Free fall with linear drag, held particles follow the gripper's shift; exact for a constant acceleration."""

    drag: float = 0.0  # [1/s]
    period: float = PERIOD

    def start(self, state: State, grip: Grip | None = None) -> State:
        """Remembers the gripper position, to shift held particles by its motion."""
        assert grip is not None
        return state.replace(memory={"grip": grip.position})

    def step(self, state: State, grip: Grip) -> State:
        """One period."""
        shift = grip.position - state.memory["grip"]  # (..., G, 3)
        index = state.held.clamp_min(0).long().unsqueeze(-1).expand(*state.held.shape, 3)
        carried = torch.gather(shift, -2, index)
        acceleration = state.velocity.new_tensor(GRAVITY) - self.drag * state.velocity
        velocity = state.velocity + acceleration * self.period
        held = (state.held >= 0).unsqueeze(-1)
        return State(
            position=state.position + torch.where(held, carried, velocity * self.period),
            velocity=torch.where(held, carried / self.period, velocity),
            held=state.held,
            memory={"grip": grip.position},
        )

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """By steps."""
        return rollout_by_steps(self, state, grips)


def line_body(count: int = 6) -> Body:
    """A straight line of `count` particles, 5 cm apart."""
    rest = np.zeros((count, 3))
    rest[:, 0] = 0.05 * np.arange(count)
    springs = np.stack((np.arange(count - 1), np.arange(1, count)), 1).astype(np.int32)
    return Body(
        kind="line", id=np.arange(count, dtype=np.uint32), rest_position=rest, mass=np.full(count, 0.01),
        springs=springs, rest_length=np.full(count - 1, 0.05), stiffness_scale=np.ones(count - 1),
        damping_scale=np.ones(count - 1), friction_scale=np.ones(count), surface=np.ones(count, bool),
        region=np.zeros(count, np.int32), bends=np.zeros((0, 3), np.int32), bend_scale=np.zeros(0),
        arc=np.linspace(0.0, 1.0, count),
    )  # fmt: skip


def still_grip(*leading: int) -> Grip:
    """One closed gripper at the origin."""
    rotation = torch.zeros(*leading, 1, 4)
    rotation[..., 0] = 1.0
    return Grip(torch.zeros(*leading, 1, 3), rotation, torch.ones(*leading, 1, dtype=torch.bool))


def random_state(generator: torch.Generator, *leading: int, count: int = 6, held_first: bool = True) -> State:
    """A thrown line: positions within 0.3 m, velocities of about 1 m/s."""
    held = torch.full((*leading, count), -1, dtype=torch.int32)
    if held_first:
        held[..., 0] = 0
    return State(
        position=0.3 * torch.rand(*leading, count, 3, generator=generator),
        velocity=torch.randn(*leading, count, 3, generator=generator),
        held=held,
    )


def episodes(dynamics: Falling, number: int, frames: int, seed: int, count: int = 6) -> list[Episode]:
    """Recordings of `dynamics`, one a throw, held by nothing; each is its own recording group."""
    generator = torch.Generator().manual_seed(seed)
    made = []
    for i in range(number):
        grips = still_grip(frames)
        state = dynamics.start(random_state(generator, count=count, held_first=False), grips.at(0))
        position = torch.cat((state.position[None], dynamics.rollout(state, grips.span(1, frames))))
        stamps = (np.arange(frames) * round(dynamics.period * 1e9)).astype(np.int64)
        tracks = Tracks(
            stamp=stamps, position=position.double().numpy(), id=np.arange(count, dtype=np.uint32),
            visible=np.ones((frames, count), bool), confidence=np.ones((frames, count), np.float32),
        )  # fmt: skip
        made.append(
            Episode(f"throw{i}", ObjectInfo(), stamps, tracks, grips, np.full(count, -1, np.int32), "train", i, GRAVITY)
        )
    return made

"""Constant velocity: free particles keep the velocity measured at the start."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pred_core.baselines.holding import attach, carry
from pred_core.dynamics import rollout_by_steps
from pred_core.types import Grip, State

_VELOCITY = "first_velocity"


@dataclass(frozen=True)
class ConstantVelocity:
    """Good over a few steps, useless over seconds: it dates how long a motion stays smooth."""

    period: float  # [s]

    def start(self, state: State, grip: Grip | None = None) -> State:
        """See `Dynamics.start`."""
        return attach(state, grip, **{_VELOCITY: state.velocity})

    def step(self, state: State, grip: Grip) -> State:
        """See `Dynamics.step`."""
        return carry(state, grip, state.position + self.period * state.memory[_VELOCITY], self.period)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """See `Dynamics.rollout`."""
        return rollout_by_steps(self, state, grips)

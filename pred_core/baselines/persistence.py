"""Persistence: the object keeps the shape it had at the start, only held particles move."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pred_core.baselines.holding import attach, carry
from pred_core.dynamics import rollout_by_steps
from pred_core.types import Grip, State


@dataclass(frozen=True)
class Persistence:
    """Hold the first shape. Every learned or simulated prediction has to beat it."""

    period: float  # [s]

    def start(self, state: State, grip: Grip | None = None) -> State:
        """See `Dynamics.start`."""
        return attach(state, grip)

    def step(self, state: State, grip: Grip) -> State:
        """See `Dynamics.step`."""
        return carry(state, grip, state.position, self.period)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """See `Dynamics.rollout`."""
        return rollout_by_steps(self, state, grips)

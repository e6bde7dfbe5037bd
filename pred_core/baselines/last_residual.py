"""Last residual: the base simulator plus its last measured residual velocity, repeated at every step.

The residual is what PReD's network learns (paper III-B): measured minus simulated velocity of one period.
It takes one measured frame more than the others (three instead of two) to see one; that frame's own score
is the base simulator's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pred_core.dynamics import Dynamics, on_clock, rollout_by_steps
from pred_core.types import Grip, State

_RESIDUAL = "last_residual"


@dataclass(frozen=True)
class LastResidual:
    """Adds one residual velocity, fed back, for as long as the rollout lasts."""

    base: Dynamics

    @property
    def period(self) -> float:
        """[s] that of the base."""
        return self.base.period

    def start(self, state: State, grip: Grip | None = None) -> State:
        """A start without history: no residual has been measured yet, so it equals the base."""
        return self._with_residual(self.base.start(state, grip), torch.zeros_like(state.velocity))

    def start_after(
        self, before: State, grip_before: Grip, now: State, grip: Grip, seconds: Tensor | None = None
    ) -> tuple[State, Tensor]:
        """Start at `now`, one period after `before`, with the residual between them.

        `before`, `now`: measured states; `seconds` (...) [s]: when in the session `before` was, None: its begin.
        Returns the started state and what the base predicted for `now` from `before`, (..., N, 3) [m]. Held particles
        have no residual.
        """
        begun, started = self.base.start(before, grip_before), self.base.start(now, grip)
        if seconds is not None:
            begun, started = on_clock(begun, seconds), on_clock(started, seconds + self.period)
        predicted = self.base.step(begun, grip)
        residual = (now.position - predicted.position) / self.period
        residual = torch.where((now.held >= 0)[..., None], torch.zeros_like(residual), residual)
        return self._with_residual(started, residual), predicted.position

    def step(self, state: State, grip: Grip) -> State:
        """See `Dynamics.step`."""
        residual = state.memory[_RESIDUAL]
        after = self.base.step(state.replace(memory=_without(state.memory)), grip)
        after = after.replace(
            velocity=after.velocity + residual, position=after.position + self.period * residual
        )
        return self._with_residual(after, residual)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """See `Dynamics.rollout`."""
        return rollout_by_steps(self, state, grips)

    def _with_residual(self, state: State, residual: Tensor) -> State:
        return state.replace(memory={**state.memory, _RESIDUAL: residual})


def _without(memory: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {key: value for key, value in memory.items() if key != _RESIDUAL}

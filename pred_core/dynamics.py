"""The one protocol every predictor obeys: spring-mass, PReD, every baseline."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from pred_core.types import Grip, State

# [m] A particle with a coordinate beyond this has left any scene a hand or an arm can reach: the prediction is
# finite but means nothing.
FARTHEST = 100.0


@runtime_checkable
class Dynamics(Protocol):
    """Predicts one period at a time; batched over leading axes; `step` returns a new State."""

    @property
    def period(self) -> float:
        """[s] the time one step covers."""

    def start(self, state: State, grip: Grip | None = None) -> State:
        """The state with this Dynamics' memory filled in.

        `grip` is the gripper pose at the state's own time; it fixes where in the gripper the held
        particles sit. Raises: InputError if particles are held and no grip is given.
        """

    def step(self, state: State, grip: Grip) -> State:
        """The state one period later; `grip` is the gripper pose at the end of the period."""

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """Positions (T, ..., N, 3) after each of T periods; equals T calls of `step`.

        `grips` has a leading axis T. Raises: DivergenceError if a position leaves the finite numbers or is
        farther than `FARTHEST` from the origin along an axis.
        """


@runtime_checkable
class Correctable(Protocol):
    """A Dynamics whose memory depends on where the particles were: a measurement that moves them is no motion."""

    def corrected(self, state: State, position: Tensor, velocity: Tensor) -> State:
        """`state` with other positions and velocities (..., N, 3), and a memory that takes them as they are."""


def corrected(dynamics: Dynamics, state: State, position: Tensor, velocity: Tensor) -> State:
    """`state` at the same time, but there, as `dynamics` can go on from it; held particles keep their place in the
    gripper."""
    if isinstance(dynamics, Correctable):
        return dynamics.corrected(state, position, velocity)
    return state.replace(position=position, velocity=velocity)


def on_clock(state: State, seconds: Tensor) -> State:
    """A state that was just started, `seconds` (...) [s] after its session began: what drifts over a session is as far
    as it is by then. As it is, where nothing in its memory has a clock."""
    clocks = {k: seconds.to(v) for k, v in state.memory.items() if k.rpartition("/")[2] == "time"}
    return state.replace(memory={**state.memory, **clocks})


def rollout_by_steps(dynamics: Dynamics, state: State, grips: Grip) -> Tensor:
    """The plain `rollout`: one `step` a period. Used by Dynamics that have nothing faster."""
    positions = []
    for t in range(grips.position.shape[0]):
        state = dynamics.step(state, grips.at(t))
        positions.append(state.position)
    return torch.stack(positions)

"""What the Dynamics makes of many motions at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.dynamics import FARTHEST, Dynamics
from pred_core.errors import DivergenceError
from pred_core.plan.curve import displacement_weights, turned
from pred_core.plan.knots import Beginning
from pred_core.types import Array, Grip, State


@dataclass(frozen=True)
class Rollouts:
    """K simulated motions of T steps; NaN from where one diverged."""

    period: float  # [s] between steps; step t ends at (t + 1) period after the plan's begin
    position: Tensor  # (T, K, N, 3) [m] world, the object
    grip: Grip  # leading axes (T, K), on CPU
    knots: Array  # (S + 2, K, G, 4) velocity knots of the motions (curve.py)
    spacing: float  # [s] of the knots
    frames: tuple[int, ...]  # the steps that costly costs look at, the last one included

    def select(self, worlds: Tensor) -> Rollouts:
        """The motions of an index (K',)."""
        chosen = worlds.cpu()
        grip = Grip(self.grip.position[:, chosen], self.grip.rotation[:, chosen], self.grip.closed[:, chosen])
        knots = self.knots[:, chosen.numpy()]
        return Rollouts(self.period, self.position[:, worlds], grip, knots, self.spacing, self.frames)

    def finite(self) -> Tensor:
        """(K,) bool: simulated to the end."""
        low, high = torch.aminmax(self.position)
        if float(low) >= -FARTHEST and float(high) <= FARTHEST:  # false for NaN; the usual case, in one pass
            return torch.ones(self.position.shape[1], dtype=torch.bool, device=self.position.device)
        return (self.position.abs() <= FARTHEST).flatten(2).all(-1).all(0)


class Simulation:
    """Rolls motions of a fixed length out through a Dynamics, from one state."""

    def __init__(self, dynamics: Dynamics, horizon: float, segments: int, frames: int):
        """horizon [s] of `segments` knots; frames: how many steps costly costs look at."""
        self._dynamics = dynamics
        steps = max(1, round(horizon / dynamics.period))
        self._spacing = horizon / segments
        times = np.minimum(dynamics.period * np.arange(1, steps + 1), horizon)
        self._weights = displacement_weights(times, segments, self._spacing).astype(np.float32)
        self._worlds: tuple[State, State] | None = None  # the last state, and its copies
        looked_at = np.ceil(steps * np.arange(1, frames + 1) / frames).astype(int) - 1
        self._frames = tuple(sorted(set(np.maximum(looked_at, 0).tolist())))

    @property
    def steps(self) -> int:
        """Periods of a rollout T."""
        return len(self._weights)

    @property
    def frames(self) -> tuple[int, ...]:
        """The steps that costly costs look at."""
        return self._frames

    def run(self, state: State, beginning: Beginning, closed: Tensor, knots: Array) -> Rollouts:
        """Roll out knots (S + 2, K, G, 4) from a started state of one world. `closed` (G,) stays as it is."""
        count = knots.shape[1]
        # float32, as every Dynamics computes.
        gone = (self._weights @ knots.astype(np.float32).reshape(len(knots), -1)).reshape(-1, *knots.shape[1:])
        position = beginning.position.astype(np.float32) + gone[..., :3]
        rotation = turned(beginning.rotation.astype(np.float32), gone[..., 3])
        grip = Grip(torch.from_numpy(position), torch.from_numpy(rotation), closed.expand(len(gone), count, -1))
        if self._worlds is None or self._worlds[0] is not state or self._worlds[1].position.shape[0] != count:
            self._worlds = (state, repeated(state, count))
        trajectory = rollout_with_nan(self._dynamics, self._worlds[1], grip)
        return Rollouts(self._dynamics.period, trajectory, grip, knots, self._spacing, self._frames)


def rollout_with_nan(dynamics: Dynamics, state: State, grips: Grip) -> Tensor:
    """`rollout` (T, K, N, 3), all NaN for a world that diverges: it is found by halving the batch."""
    count = state.position.shape[0]
    try:
        return dynamics.rollout(state, grips)
    except DivergenceError:
        if count == 1:
            return state.position.new_full((grips.position.shape[0], *state.position.shape), torch.nan)
    parts = []
    for half in (slice(0, count // 2), slice(count // 2, count)):
        part = State(state.position[half], state.velocity[half], state.held[half],
                     {k: v[half] for k, v in state.memory.items()})  # fmt: skip
        grip = Grip(grips.position[:, half], grips.rotation[:, half], grips.closed[:, half])
        parts.append(rollout_with_nan(dynamics, part, grip))
    return torch.cat(parts, dim=1)


def repeated(state: State, count: int) -> State:
    """One world (N, 3) as `count` equal worlds, memory included."""

    def many(value: Tensor) -> Tensor:
        return value.expand(count, *value.shape).contiguous()

    memory = {k: many(v) for k, v in state.memory.items()}
    return State(many(state.position), many(state.velocity), many(state.held), memory)

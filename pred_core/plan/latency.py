"""The state a plan begins at: measured, then simulated on along the plan in force until the new plan can start.

Planning takes time and measurements are old when they arrive. A plan computed from the measured state would begin
where the object no longer is; this one begins where it will be, if the Dynamics is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pred_core.bag.align import slerp
from pred_core.dynamics import Dynamics
from pred_core.errors import DivergenceError, InputError
from pred_core.plan.course import Course
from pred_core.plan.knots import Beginning
from pred_core.plan.plan import NS, Plan
from pred_core.types import Array, Grip, State


@dataclass(frozen=True)
class Observation:
    """What is known about one instant: the object and the grippers, as measured."""

    stamp: int  # [ns] capture time
    state: State  # (N, 3), one world, without memory
    position: Array  # (G, 3) [m] world, measured
    rotation: Array  # (G, 4) wxyz, measured

    def check(self, count: int) -> None:
        """Raise InputError unless finite, of `count` particles, and held by a gripper that exists."""
        x, v, held = self.state.position, self.state.velocity, self.state.held
        if x.shape != (count, 3) or v.shape != (count, 3) or held.shape != (count,):
            got = f"position {tuple(x.shape)}"
            raise InputError("the state does not fit the twin", got=got, allowed=f"({count}, 3)")
        bad = ~torch.isfinite(x + v).all(-1)
        if bool(bad.any()):
            raise InputError(
                "the state is not finite", got=f"particles {torch.nonzero(bad).flatten()[:5].tolist()}",
                next_step="Check the tracker and the predictor",
            )  # fmt: skip
        if not (np.isfinite(self.position).all() and np.isfinite(self.rotation).all()):
            raise InputError("the gripper pose is not finite", next_step="Check the source of gripper/pose")
        if int(held.max()) >= len(self.position):
            raise InputError("held gripper index", got=int(held.max()), allowed=f"below {len(self.position)} grippers")
        if int(held.max()) < 0:
            raise InputError("no gripper holds the object", got="held is -1 everywhere",
                             next_step="Close a gripper on it, or name what it holds")  # fmt: skip

    def closed(self) -> torch.Tensor:
        """(G,) bool: a gripper is closed if it holds something."""
        return torch.tensor([bool((self.state.held == g).any()) for g in range(len(self.position))])


@dataclass(frozen=True)
class Departure:
    """Where and when a plan begins."""

    stamp: int  # [ns]
    state: State  # started, with memory, at `stamp`
    beginning: Beginning  # the grippers then


def departure(dynamics: Dynamics, seen: Observation, begin: int, in_force: Plan | Course | None) -> Departure:
    """The state and the grippers at `begin` [ns], rounded to whole periods after the observation, not before it.

    The grippers go along the plan, or the course of plans, in force; where the measured pose is off it, the difference
    fades out linearly until the plan begins. Without a plan they stay where they were measured.

    Raises: DivergenceError if the simulation leaves the finite numbers on the way.
    """
    period = round(dynamics.period * NS)
    steps = max(0, round((begin - seen.stamp) / period))
    closed = seen.closed()
    nothing = np.zeros((len(seen.position), 4))
    measured = Beginning(seen.position, seen.rotation, nothing, nothing)
    state = dynamics.start(seen.state, _grip(seen.position, seen.rotation, closed))
    offset = np.zeros_like(seen.position) if in_force is None else seen.position - in_force.at(seen.stamp).position
    for k in range(1, steps + 1):
        told = measured if in_force is None else in_force.at(seen.stamp + k * period)
        share = k / steps
        rotation = slerp(seen.rotation, told.rotation, np.full(len(seen.rotation), share))
        state = dynamics.step(state, _grip(told.position + (1.0 - share) * offset, rotation, closed))
    if not bool(torch.isfinite(state.position).all()):
        raise DivergenceError(f"the simulation diverged within {steps} steps after the measured state",
                              next_step="Check the state and the twin")  # fmt: skip
    stamp = seen.stamp + steps * period
    return Departure(stamp, state, measured if in_force is None else in_force.at(stamp))


def tracking_error(seen: Observation, in_force: Plan | Course) -> float:
    """[m] how far the farthest gripper is from where what is in force has it at the observation's time.

    Raises: InputError if that is for another number of grippers.
    """
    told = in_force.at(seen.stamp).position
    if told.shape != seen.position.shape:
        raise InputError("the plans in force are for other grippers", got=len(seen.position), allowed=len(told),
                         next_step="Call ~/reset; then it plans for those that are there")  # fmt: skip
    return float(np.linalg.norm(seen.position - told, axis=-1).max())


def _grip(position: Array, rotation: Array, closed: torch.Tensor) -> Grip:
    return Grip(
        torch.as_tensor(position, dtype=torch.float32), torch.as_tensor(rotation, dtype=torch.float32), closed
    )

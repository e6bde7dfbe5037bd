"""Plans without a robot: once, or again and again with the twin itself as the world (model predictive control)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from pred_core.dynamics import Dynamics
from pred_core.errors import InputError
from pred_core.plan.goal_cost import GoalCost
from pred_core.plan.latency import Observation, departure
from pred_core.plan.plan import NS, Plan
from pred_core.plan.planner import Planner
from pred_core.types import Array, Grip

Report = Callable[[int, int, Plan], None]  # replans done, planned, the newest plan


@dataclass(frozen=True)
class Run:
    """What was carried out, frame by frame; frame 0 is the start."""

    period: float  # [s]
    position: Array  # (T + 1, N, 3) [m] world
    gripper: Array  # (T + 1, G, 3) [m] world
    rotation: Array  # (T + 1, G, 4) wxyz
    distance: Array  # (T + 1,) [m] two-sided chamfer distance to the goal
    plans: tuple[Plan, ...]


def carry_out(
    planner: Planner, world: Dynamics, seen: Observation, replans: int, step: float, report: Report
) -> Run:
    """Plan, let `world` follow the plan for `step` [s], observe it, plan again; follow the last plan to its end.

    `world` may be another Dynamics than the planner's: what the planner believes is then wrong, as in a real world.
    Raises: InputError if the objective has no goal, or the step is longer than what a plan sends.
    """
    goal = next((c for c in planner.objective.costs if isinstance(c, GoalCost)), None)
    if goal is None:
        raise InputError("there is no goal cost", next_step="Give costs.goal or costs.goal_end a weight")
    period, closed = round(world.period * NS), seen.closed()
    frames = max(1, round(step / world.period))
    if step > planner.config.send:
        raise InputError("a plan is followed longer than it is sent", got=f"{step:g} s",
                         allowed=f"send = {planner.config.send:g} s")  # fmt: skip
    state = world.start(seen.state, _grip(seen.position, seen.rotation, closed))
    stamp, force = seen.stamp, None
    positions = [state.position.double().cpu().numpy()]
    grippers, rotations = [seen.position], [seen.rotation]
    plans: list[Plan] = []
    for k in range(replans):
        now = Observation(stamp, state.replace(memory={}), grippers[-1], rotations[-1])
        force = planner.plan(now, in_force=force)
        plans.append(force)
        report(k + 1, replans, force)
        last = k == replans - 1
        count = int(np.ceil(force.sent.seconds / world.period)) if last else frames
        for _ in range(count):
            stamp += period
            told = force.at(stamp)
            state = world.step(state, _grip(told.position, told.rotation, closed))
            positions.append(state.position.double().cpu().numpy())
            grippers.append(told.position)
            rotations.append(told.rotation)
    moved = np.stack(positions)
    distance = goal.distance(torch.as_tensor(moved, dtype=torch.float32)).double().numpy()
    return Run(world.period, moved, np.stack(grippers), np.stack(rotations), distance, tuple(plans))


def settled(dynamics: Dynamics, seen: Observation, seconds: float) -> Observation:
    """The object after `seconds` [s] in grippers that do not move; 0 s: as seen."""
    seen.check(seen.state.position.shape[0])
    if seconds == 0.0:
        return seen
    later = departure(dynamics, seen, seen.stamp + round(seconds * NS), None)
    state = later.state.replace(memory={})
    return Observation(later.stamp, state, seen.position, seen.rotation)


def _grip(position: Array, rotation: Array, closed: torch.Tensor) -> Grip:
    return Grip(
        torch.as_tensor(position, dtype=torch.float32), torch.as_tensor(rotation, dtype=torch.float32), closed
    )

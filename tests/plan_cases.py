"""Small worlds for the planner's tests: an object that moves rigidly with its gripper, and plans within a wide box."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pred_core.errors import DivergenceError
from pred_core.frames import quaternion_conjugate, quaternion_multiply, quaternion_rotate
from pred_core.plan.config import MotionConfig, PlannerConfig, SearchConfig
from pred_core.plan.latency import Observation
from pred_core.types import Grip, State

DOWN = np.array([[1.0, 0.0, 0.0, 0.0]])
BOX = {"x_low": -1.0, "x_high": 1.0, "y_low": -1.0, "y_high": 1.0, "z_low": 0.0, "z_high": 1.0}
HOME = np.array([[0.0, 0.0, 0.3]])


class Rigid:
    """A Dynamics with a result known by hand: every particle keeps its place in the frame of gripper 0.

    `drift` [m/s] moves the object in addition, whatever the gripper does; particles beyond `wall` [m] along x diverge.
    """

    def __init__(self, period: float = 0.05, drift: tuple[float, float, float] = (0.0, 0.0, 0.0), wall: float = 1e9):
        self.period, self.drift, self.wall = period, torch.tensor(drift), wall

    def start(self, state: State, grip: Grip | None = None) -> State:
        """Remember the gripper's pose and what has drifted."""
        assert grip is not None
        lead = state.position.shape[:-2]
        memory = {"p": grip.position[..., 0, :], "q": grip.rotation[..., 0, :], "age": torch.zeros(lead)}
        return state.replace(memory=memory)

    def step(self, state: State, grip: Grip) -> State:
        """Turn and shift with the gripper, plus the drift."""
        p, q = grip.position[..., 0, :], grip.rotation[..., 0, :]
        turn = quaternion_multiply(q, quaternion_conjugate(state.memory["q"]))
        arm = quaternion_rotate(turn.unsqueeze(-2), state.position - state.memory["p"].unsqueeze(-2))
        position = arm + p.unsqueeze(-2) + self.drift * self.period
        if bool((position[..., 0] > self.wall).any()):
            raise DivergenceError("beyond the wall")
        memory = {"p": p, "q": q, "age": state.memory["age"] + 1}
        return State(position, (position - state.position) / self.period, state.held, memory)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """Step by step."""
        positions = []
        for t in range(grips.position.shape[0]):
            state = self.step(state, grips.at(t))
            positions.append(state.position)
        return torch.stack(positions)


def line_points(count: int = 6, spacing: float = 0.02) -> np.ndarray:
    """(N, 3) [m] a line along x whose first particle is at HOME."""
    points = np.repeat(HOME, count, axis=0)
    points[:, 0] += spacing * np.arange(count)
    return points


def seen(stamp: int = 0, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Observation:
    """The line at rest, first particle held by gripper 0."""
    points = torch.as_tensor(line_points() + np.array(offset), dtype=torch.float32)
    held = torch.full((len(points),), -1, dtype=torch.int32)
    held[0] = 0
    return Observation(stamp, State(points, torch.zeros_like(points), held), HOME + np.array(offset), DOWN.copy())


def settings(**search: float) -> PlannerConfig:
    """Fast settings in a wide box: 1 s, 6 segments."""
    motion = MotionConfig(horizon=1.2, knots=6, speed=0.5, acceleration=4.0, turn_speed=1.5, **BOX)
    values = {"samples": 32, "iterations": 6, "chunk": 16, "noise": 0.25, "turn_noise": 2.0, "frames": 4, **search}
    return PlannerConfig(motion=motion, search=SearchConfig(**values))  # type: ignore[arg-type]


def without(config: PlannerConfig, *names: str) -> PlannerConfig:
    """The settings with the weights of some costs at 0."""
    return dataclasses.replace(config, costs=dataclasses.replace(config.costs, **dict.fromkeys(names, 0.0)))

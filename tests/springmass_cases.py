"""Small objects that the simulator's tests share, so that they share compiled kernels too."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pred_core.springmass import build_body
from pred_core.types import Body, Grip, Physics, Scene, State

NOWHERE = Scene(gravity=(0.0, 0.0, 0.0))
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def line(count: int = 12, length: float = 0.55, mass: float = 0.06, radius: float = 0.0, **physics: float) -> Body:
    """A straight line along x from the origin, springs between neighbours only."""
    x = np.zeros((count, 3))
    x[:, 0] = np.linspace(0.0, length, count)
    values = {"connection_threshold": 1.5 * length / (count - 1), "max_springs": 4, **physics}
    return build_body("line", x, mass, Physics(**values), radius=radius)  # type: ignore[arg-type]


def zigzag(count: int, edge: float, degrees: float) -> np.ndarray:
    """Positions (N, 3) [m] of a line bent to and fro in the plane, `degrees` between one edge and the next."""
    x = np.zeros((count, 3))
    half = np.radians(degrees) / 2
    side = np.where(np.arange(count - 1) % 2, half, -half)
    x[1:, 0], x[1:, 1] = np.cumsum(edge * np.cos(side)), np.cumsum(edge * np.sin(side))
    return x


def blob(rng: np.random.Generator, count: int = 40, radius: float = 0.01) -> Body:
    """A random ball of particles whose scales all differ."""
    x = rng.uniform(-0.1, 0.1, (count, 3))
    body = build_body("volume", x, 0.4, Physics(connection_threshold=0.12, max_springs=9), radius=radius)
    springs = len(body.springs)
    return dataclasses.replace(
        body,
        mass=body.mass * rng.uniform(0.5, 2.0, count),
        stiffness_scale=rng.uniform(0.5, 2.0, springs),
        damping_scale=rng.uniform(0.0, 2.0, springs),
        friction_scale=rng.uniform(0.5, 1.5, count),
    )


def particles(position: np.ndarray, mass: float = 0.1, radius: float = 0.0) -> Body:
    """Loose particles: springs exist but are as short as none; each falls alone."""
    body = build_body("volume", position, mass * len(position), Physics(connection_threshold=1e-9), radius=radius)
    return body


def state_of(position: np.ndarray | Tensor, velocity: np.ndarray | Tensor | float = 0.0) -> State:
    """A free state (..., N, 3)."""
    p = torch.as_tensor(position, dtype=torch.float32)
    v = torch.zeros_like(p) + torch.as_tensor(velocity, dtype=torch.float32)
    return State(p.contiguous(), v.contiguous(), torch.full(p.shape[:-1], -1, dtype=torch.int32))


def holding(state: State, entries: dict[int, int]) -> State:
    """The state with particle -> gripper held."""
    held = state.held.clone()
    for particle, gripper in entries.items():
        held[..., particle] = gripper
    return state.replace(held=held)


def still(position: Tensor | np.ndarray, periods: int = 0, closed: bool = True) -> Grip:
    """Unturned grippers at (..., G, 3), with a leading time axis where `periods` is given."""
    p = torch.as_tensor(position, dtype=torch.float32)
    if periods:
        p = p.expand(periods, *p.shape)
    q = torch.tensor(IDENTITY).expand(*p.shape[:-1], 4)
    return Grip(p, q, torch.full(p.shape[:-1], closed))


def nobody(periods: int = 0) -> Grip:
    """No gripper."""
    lead = (periods,) if periods else ()
    return Grip(torch.zeros(*lead, 0, 3), torch.zeros(*lead, 0, 4), torch.zeros(*lead, 0, dtype=torch.bool))

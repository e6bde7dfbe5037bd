"""A small world whose motion is known by hand: five particles on a line that fly straight on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.springmass.topology import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Grip, Physics, Scene, State

PERIOD = 0.01  # [s]
COUNT = 5  # particles on a line, 5 cm apart, the first one held
STEP = 10_000_000  # [ns]
START = 7_000_000_000  # [ns]


class Straight:
    """A Dynamics with a hand-worked result: free particles fly straight on, held ones follow their gripper."""

    period = PERIOD

    def __init__(self, diverges_after: int = 10**9):
        self.left = diverges_after

    def start(self, state: State, grip: Grip | None = None) -> State:
        """Nothing to remember."""
        return state

    def step(self, state: State, grip: Grip) -> State:
        """x + v dt; held: the gripper's place."""
        self.left -= 1
        position = state.position + state.velocity * PERIOD
        held = state.held >= 0
        position[held] = grip.position[state.held[held].long()]
        if self.left < 0:
            position = position * torch.nan
        return state.replace(position=position)

    def rollout(self, state: State, grips: Grip) -> torch.Tensor:
        """Step by step."""
        raise NotImplementedError("the predictor steps")


def make_twin(folder: Path) -> Path:
    """A twin of five particles, ids 0 to 4, on disk."""
    rest = np.zeros((COUNT, 3))
    rest[:, 0] = 0.05 * np.arange(COUNT)
    physics = Physics(stiffness=100.0, damping=0.05, connection_threshold=0.06, max_springs=4)
    body = build_body("line", rest, 0.05, physics, id=np.arange(COUNT, dtype=np.uint32))
    Twin(TwinMeta(period=PERIOD), body, physics, Scene()).save(folder)
    return folder


def points(frame: int, ids: int = COUNT) -> PointFrame:
    """Frame k: the line moves along x with 0.5 m/s."""
    position = np.zeros((ids, 3))
    position[:, 0] = 0.05 * np.arange(ids) + 0.5 * PERIOD * frame
    identity = np.arange(ids, dtype=np.uint32)
    return PointFrame(START + frame * STEP, position, identity, np.ones(ids, np.float32), None)


def pose(frame: int) -> PoseFrame:
    """The gripper holds particle 0."""
    return PoseFrame(START + frame * STEP, points(frame).position[:1], np.array([[1.0, 0.0, 0.0, 0.0]]))


CLOSED = np.array([True])

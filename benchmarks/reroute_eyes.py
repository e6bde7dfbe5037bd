"""What the planner is shown of the cell: the truth, or what four cameras, the tracker and the twin make of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch

from pred_core.bag.clouds import PointFrame
from pred_core.cli.plant_collect import TrackerWatcher
from pred_core.dynamics import Dynamics
from pred_core.estimate.estimator import Estimator
from pred_core.estimate.grasped import grasp_of
from pred_core.estimate.measurement import Measurement
from pred_core.plan.latency import Observation
from pred_core.plant.live.cell import Cell
from pred_core.plant.live.station import Moment
from pred_core.twin import Twin
from pred_core.types import Array, Grip, State

POSE_EVERY = 2  # moments between the gripper poses that the tracker gets


class Eyes(Protocol):
    """Sees every moment of a trial, and says what is known."""

    def see(self, moments: Sequence[Moment]) -> None:
        """What happened since the last call."""
        ...

    def observe(self) -> Observation | None:
        """The newest state with its stamp; None: the object is not found, or lost."""
        ...


class TrueEyes:
    """The true particles."""

    def __init__(self, twin: Twin):
        self._held = held_of(twin)
        self._moment: Moment | None = None

    def see(self, moments: Sequence[Moment]) -> None:
        """Keep the last one."""
        self._moment = moments[-1]

    def observe(self) -> Observation | None:
        """The truth of the last moment."""
        if self._moment is None:
            return None
        truth = self._moment.truth
        return _observation(self._moment.stamp, truth.rope, truth.rope_velocity, self._held, truth.gripper.position,
                            truth.gripper.rotation)  # fmt: skip


class CameraEyes:
    """Pictures to the tracker, its tracks to the estimator, which predicts with the twin from picture to picture."""

    def __init__(self, twin: Twin, cell: Cell, dynamics: Dynamics):
        """dynamics: of the twin, in the scene with its slot; its period is the time between pictures."""
        self._twin, self._held = twin, held_of(twin)
        self._watcher = TrackerWatcher(cell)
        self._estimator = Estimator(dynamics, twin.body)
        self._row = {int(id): k for k, id in enumerate(twin.body.id)}
        self._count = 0
        self._started = False
        self._seen: tuple[Array, Array] | None = None  # hand and rotation at the newest picture

    def see(self, moments: Sequence[Moment]) -> None:
        """Poses and pictures in the order they came."""
        for moment in moments:
            pose = moment.truth.gripper  # what the arm measures
            if self._count % POSE_EVERY == 0 or moment.pictures:
                self._watcher.pose(moment.stamp, pose.position, pose.rotation, moment.truth.closed)
            self._count += 1
            if moment.pictures:
                self._take(moment, self._watcher.pictures(moment.pictures))

    def observe(self) -> Observation | None:
        """The estimate; None before it begins, and without tracks for too long."""
        one = self._estimator
        if not self._started or self._seen is None or one.health.level(one.stamp) == "stopped":
            return None
        return Observation(one.stamp, one.state.replace(memory={}), self._seen[0][None], self._seen[1][None])

    def _take(self, moment: Moment, points: PointFrame | None) -> None:
        pose, one = moment.truth.gripper, self._estimator
        self._seen = pose.position, pose.rotation
        hand, rotation = (torch.as_tensor(a[None], dtype=torch.float32) for a in self._seen)
        grip = Grip(hand, rotation, torch.tensor([moment.truth.closed]))
        seen = None if points is None else self._measured(points)
        if self._started:
            one.step(moment.stamp, grip)
            if seen is not None:
                one.correct(seen)
        elif seen is not None:
            one.starter.add(seen)
            found = one.starter.find()
            if found is not None:
                x, v = (torch.as_tensor(a, dtype=torch.float32) for a in (found.position, found.velocity))
                levers = {self._row[id]: place for id, place in self._twin.meta.levers}
                state = State(x, v, self._held)
                grasp = grasp_of(self._twin.body, state, grip, levers)
                one.start(moment.stamp, grasp.taken(state, grip, found.track, one.config.slipped), grip, grasp)
                self._started = True

    def _measured(self, points: PointFrame) -> Measurement:
        index = np.array([self._row[int(id)] for id in points.id], np.int64)
        return Measurement(points.stamp, index, points.position, np.asarray(points.confidence, float))


def held_of(twin: Twin) -> torch.Tensor:
    """(N,) int32 gripper index of each particle, -1 = free, as the twin knows it."""
    held = np.full(twin.body.count, -1, np.int32)
    for particle, gripper in twin.meta.held:
        held[twin.body.id == particle] = gripper
    return torch.as_tensor(held)


def _observation(
    stamp: int, position: Array, velocity: Array, held: torch.Tensor, hand: Array, rotation: Array
) -> Observation:
    x, v = (torch.as_tensor(a, dtype=torch.float32) for a in (position, velocity))
    return Observation(stamp, State(x, v, held), hand[None], rotation[None])

"""Tracks and gripper poses in, predictions out: the predictor's bookkeeping, without ROS.

A run starts from the first two complete tracker frames (the velocity is their difference) and then steps once
for each period of measured gripper poses: exactly what the offline evaluation does, message by message.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from pred_core.bag.clouds import PointFrame
from pred_core.live.holding import held_at_start
from pred_core.live.laps import Time
from pred_core.live.prediction_records import Pose, Prediction
from pred_core.live.run import ON_GRID, Run
from pred_core.types import Grip, State


class Predictor(Run):
    """The model alone from a measured start, or, with the rule `correct`, restarted from every measured frame."""

    def advance(self) -> Iterable[Prediction]:
        """Predictions that the data so far allow, oldest first.

        Raises: DivergenceError when the simulation leaves the finite numbers; the run is then halted
        until `reset` or a jump or gap in the poses.
        """
        while self._poses and not self._cancelled:
            if self._state is None:
                if self.halted is not None:
                    if not self._ends_run(self._poses[0]):
                        self._before = self._poses.popleft()
                        continue
                    self._end_run(self._poses[0])
                if not self._start():
                    return
                continue
            pose = self._poses[0]
            if self._ends_run(pose):
                self._end_run(pose)
                continue
            prediction = self._step(self._poses.popleft())
            if prediction is not None:
                yield prediction

    def _start(self) -> bool:
        """Start from the oldest two complete neighbouring frames that have a pose. False: more data needed."""
        while self._frames and self._frames[0][0] < self._begin:
            self._frames.popleft()
        while len(self._frames) >= 2:
            (lap, first_stamp), first = self._frames[0]
            time, second = self._frames[1]
            missing = self._missing(first) | self._missing(second)
            spacing = (second.stamp - first_stamp) / self._period
            if missing or time[0] != lap or abs(spacing - 1.0) > ON_GRID:
                self.counts.waiting_for = sorted(missing)
                self.counts.spacing = spacing
                self._frames.popleft()
                continue
            self.counts.waiting_for, self.counts.spacing = [], 1.0
            return self._start_at(time, first, second)
        return False

    def _start_at(self, time: Time, first: PointFrame, second: PointFrame) -> bool:
        grip = self._reach(time)
        if grip is None:
            if not self._poses:
                return False
            self._frames.popleft()  # the poses begin later: this pair cannot be used
            return len(self._frames) >= 2
        order = np.argsort(second.id)[np.searchsorted(np.sort(second.id), self._ids)]
        earlier = np.argsort(first.id)[np.searchsorted(np.sort(first.id), self._ids)]
        now, before = second.position[order], first.position[earlier]
        dt = (second.stamp - first.stamp) * 1e-9
        held = held_at_start(self._ids, self._held, before, self._grip_near(first.stamp, grip), grip)
        state = State(
            position=torch.as_tensor(now, dtype=torch.float32),
            velocity=torch.as_tensor((now - before) / dt, dtype=torch.float32),
            held=torch.as_tensor(held, dtype=torch.int32),
        )
        self._state = self._dynamics.start(state, grip)
        self._time = time
        self.counts.runs += 1
        self._prune()
        return True

    def _step(self, pose: Pose) -> Prediction | None:
        assert self._state is not None
        reached = self._next_grip(pose)
        if reached is None:
            return None
        grip, stamp, previous = reached
        begin = self._corrected(self._state) if self._rules.correct == "tracks" else self._state
        state = self._stepped(begin, grip, stamp)
        self.counts.steps += 1
        self._state, self._time = state, (pose.lap, stamp)
        self._prune()
        return self._ahead(stamp, state, grip, previous)

    def _corrected(self, state: State) -> State:
        """Particles measured at the state's time (and one frame before) take their measured place and velocity."""
        frames = [f for t, f in self._frames if t[0] == self._time[0]]
        now = next((f for f in frames if abs(f.stamp - self._time[1]) <= ON_GRID * self._period), None)
        if now is None:
            return state
        before = next((f for f in reversed(frames) if 0 < now.stamp - f.stamp < 1.5 * self._period), None)
        if before is None:
            return state
        position, velocity = state.position.clone(), state.velocity.clone()
        column = {int(i): k for k, i in enumerate(self._ids)}
        earlier = {int(i): p for i, p, v in zip(before.id, before.position, before.visible, strict=True) if v}
        dt = (now.stamp - before.stamp) * 1e-9
        for i, p, seen in zip(now.id, now.position, now.visible, strict=True):
            if seen and int(i) in earlier:
                k = column[int(i)]
                position[k] = torch.as_tensor(p, dtype=torch.float32)
                velocity[k] = torch.as_tensor((p - earlier[int(i)]) / dt, dtype=torch.float32)
        return state.replace(position=position, velocity=velocity)

    def _prune(self) -> None:
        """Forget tracker frames that lie more than one period before the state."""
        while self._frames and self._frames[0][0] < (self._time[0], self._time[1] - round(1.4 * self._period)):
            self._frames.popleft()

    def _missing(self, frame: PointFrame) -> set[int]:
        return set(self._ids.tolist()) - set(frame.id[frame.visible].tolist())

    def _grip_near(self, stamp: int, otherwise: Grip) -> Grip:
        """The gripper at the first frame of a run, where the pose then was measured."""
        if self._before is None or abs(self._before.pose.stamp - stamp) > ON_GRID * self._period:
            return otherwise
        return self._before.grip()

"""Tracks and gripper poses in, corrected states out: `pred_core/estimate` on live data, without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.clouds import PointFrame
from pred_core.calibration import Calibration
from pred_core.dynamics import Dynamics
from pred_core.errors import DivergenceError
from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.estimator import Estimator
from pred_core.estimate.grasped import Levers, grasp_of
from pred_core.estimate.measurement import Measurement, Outcome
from pred_core.estimate.starter import Start
from pred_core.live.condition import Condition
from pred_core.live.holding import held_at_start
from pred_core.live.laps import Time
from pred_core.live.prediction_records import Pose, Prediction, Rules
from pred_core.live.run import Run
from pred_core.types import Body, Grip, State


class Follower(Run):
    """Starts from the tracks of a short window, complete or not; then every frame corrects the state of its own time.

    A prediction is given for each period of gripper poses and again, with the same stamp, when tracks corrected it.
    Without tracks for too long, none is given until tracks are back.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        body: Body,
        held: Mapping[int, int] | None,
        rules: Rules,
        calibration: Calibration | None = None,
        config: EstimatorConfig | None = None,
        levers: Levers | None = None,
    ):
        """levers: particle id -> place in its gripper's frame [m], of those that are held (`TwinMeta.levers`)."""
        super().__init__(dynamics, body.id, held, rules, calibration)
        self._estimator = Estimator(dynamics, body, config)
        self._body = body
        self._row = {int(id): k for k, id in enumerate(self._ids)}
        self._levers = {self._row[id]: place for id, place in (levers or {}).items() if id in self._row}
        self._found: tuple[Time, Start] | None = None
        self._newest: Outcome | None = None
        self._lost: Outcome | None = None
        self._moved: tuple[Grip, Pose] | None = None  # the gripper at the state's time, and the last pose before

    def condition(self) -> Condition:
        """How far the state can be trusted now."""
        one, stamp = self._estimator, self._time[1]
        return Condition(
            stamp, one.health.level(stamp), one.health.blind_for(stamp), one.config.stop_after, self._newest,
            self._lost, float(np.sqrt(one.scale.value)), one.tally, one.missing if self.running else 0,
        )  # fmt: skip

    def waiting(self) -> str:
        """What a start lacks."""
        if self._found is not None:
            return "no gripper pose at the time of the tracks yet"
        return super().waiting() if self.counts.waiting_for else "no tracks yet"

    def reset(self) -> None:
        """End the run and forget all stamps; the next one starts from the tracks that follow."""
        super().reset()
        self._forget()

    def advance(self) -> Iterable[Prediction]:
        """States and predictions that the data so far allow, oldest first.

        Raises: DivergenceError when the simulation leaves the finite numbers; it starts anew from the next tracks.
        """
        try:
            yield from self._advance()
        except DivergenceError:
            self._state = self.halted = None
            self._forget()
            raise

    def _advance(self) -> Iterator[Prediction]:
        while not self._cancelled:
            if self._state is None:
                if not self._start():
                    return
            elif self._poses and self._ends_run(self._poses[0]):
                self._end_run(self._poses[0])
            elif self._frames and self._frames[0][0] <= self._time:
                yield from self._given(self._correct(*self._frames.popleft()))
            elif self._poses:
                yield from self._given(self._step(self._poses.popleft()))
            else:
                return

    def _end_run(self, pose: Pose) -> None:
        super()._end_run(pose)
        self._forget()

    def _forget(self) -> None:
        self._estimator.starter.clear()
        self._found = self._newest = self._lost = None

    def _start(self) -> bool:
        """Start once the tracks give a state and the poses reach its time. False: more data needed."""
        while self._frames and self._frames[0][0] < self._begin:
            self._frames.popleft()
        while self._found is None and self._frames:
            time, frame = self._frames.popleft()
            self._estimator.starter.add(self._measured(frame))
            found = self._estimator.starter.find()
            self._found = None if found is None else (time, found)
        if self._found is None:
            self.counts.waiting_for = self._ids[self._estimator.starter.unseen()].tolist()
            return False
        self.counts.waiting_for = []
        time, found = self._found
        grip = self._reach(time)
        if grip is None:
            if self._poses:  # they begin later
                self._found = None
                return bool(self._frames)
            return False
        self._begin_with(time, found, grip)
        return True

    def _begin_with(self, time: Time, found: Start, grip: Grip) -> None:
        held = held_at_start(self._ids, self._held, found.position, grip, grip)
        state = State(
            position=torch.as_tensor(found.position, dtype=torch.float32),
            velocity=torch.as_tensor(found.velocity, dtype=torch.float32),
            held=torch.as_tensor(held, dtype=torch.int32),
        )
        grasp = grasp_of(self._body, state, grip, self._levers)
        begun = grasp.taken(state, grip, found.track, self._estimator.config.slipped)
        self._estimator.tally.let_go += int(((state.held >= 0) & (begun.held < 0)).sum())
        self._estimator.start(time[1], begun, grip, grasp)
        self._state, self._time, self._found = self._estimator.state, time, None
        assert self._before is not None
        self._moved = grip, self._before
        self.counts.runs += 1

    def _step(self, pose: Pose) -> Prediction | None:
        reached = self._next_grip(pose)
        if reached is None:
            return None
        grip, stamp, previous = reached
        self._state = self._finite(lambda: self._estimator.step(stamp, grip), stamp)
        self._time, self._moved = (pose.lap, stamp), (grip, previous)
        self.counts.steps += 1
        return self._ahead(stamp, self._state, grip, previous)

    def _correct(self, time: Time, frame: PointFrame) -> Prediction | None:
        if time[0] != self._time[0]:
            return None  # of the lap before
        seen = self._measured(frame)

        def corrected() -> State:
            self._newest = self._estimator.correct(seen)
            return self._estimator.state

        self._state = self._finite(corrected, self._time[1])
        assert self._moved is not None and self._newest is not None
        self._lost = self._newest if self._newest.anew else self._lost
        if not (self._newest.used.any() or self._newest.anew):
            return None
        return self._ahead(self._time[1], self._state, *self._moved)

    def _given(self, prediction: Prediction | None) -> Iterator[Prediction]:
        """The prediction, unless it stands on the model alone for too long."""
        if prediction is not None and self._estimator.health.level(prediction.stamp) != "stopped":
            yield prediction

    def _measured(self, frame: PointFrame) -> Measurement:
        seen = frame.visible
        index: NDArray[np.int64] = np.array([self._row[int(i)] for i in frame.id[seen]], np.int64)
        return Measurement(frame.stamp, index, frame.position[seen], frame.confidence[seen].astype(np.float64))

"""What every live run of a Dynamics shares: messages in, their place in time, the gripper at the ends of periods.

Stamps, jumps and holes are treated here, without ROS; what a run makes of them is its own (`prediction.py`: open loop
from a measured start; `following.py`: corrected by the tracks).
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.align import slerp
from pred_core.bag.clouds import LARGEST_EXTENT, PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.in_line import InLine
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS
from pred_core.calibration import Calibration
from pred_core.dynamics import Dynamics
from pred_core.errors import DivergenceError, InputError, TwinError
from pred_core.live.delay import DelayedPoses
from pred_core.live.laps import Laps, Time
from pred_core.live.prediction_records import Counts, Pose, Prediction, Rules, grip_of
from pred_core.types import Grip, State

LARGEST_SPEED = 100.0  # [m/s] of a particle in a robot's reach; springs that tear bring thousands
ON_GRID = 0.25  # periods; where poses come once a period, one this close to the next step is the step
EXACT = 1e-3  # periods; else only one this close is: between others the gripper is interpolated
PACE = 0.1  # periods by which the time between poses may differ from one, where they come once a period
SPACINGS = 9  # between poses, whose median counts
MAX_WAITING = 4_000  # tracker frames kept while poses are awaited, and poses while frames are


class Run:
    """Feed `add_points` and `add_pose` in order of arrival; `advance` gives what can be predicted now.

    What comes in is corrected by `calibration`; predictions are true places, at the stamps of the tracker (what they
    show is its delay older).
    """

    def __init__(
        self,
        dynamics: Dynamics,
        ids: NDArray[np.uint32],
        held: Mapping[int, int] | None,
        rules: Rules,
        calibration: Calibration | None = None,
    ):
        self._dynamics = dynamics
        self._ids = np.asarray(ids, np.uint32)
        self._held = held
        self._rules = rules
        self._calibration = calibration or Calibration()
        self._delayed = DelayedPoses(self._calibration.delay, rules.max_gap) if self._calibration.delay else None
        self._posed: InLine[tuple[PoseFrame, NDArray[np.bool_]]] = InLine(GRIPPER_POSE, rules.max_gap, rules.max_gap)
        self._period = round(dynamics.period * 1e9)  # [ns]
        self._frames: deque[tuple[Time, PointFrame]] = deque()
        self._poses: deque[Pose] = deque()
        self._laps: Laps[Callable[[Time], None]] = Laps(rules.max_gap)
        self._pose_lap = 0
        self._state: State | None = None
        self._time: Time = (-1, 0)  # of the state
        self._begin: Time = (-1, 0)  # frames before it belong to what is over
        self._cancelled = False
        self._before: Pose | None = None  # the last pose at or before the state's next time
        self._spacings: deque[int] = deque(maxlen=SPACINGS)  # [ns] between the newest poses
        self.halted: DivergenceError | None = None
        self.counts = Counts()

    @property
    def running(self) -> bool:
        """True once a run has started and not ended."""
        return self._state is not None

    def waiting(self) -> str:
        """What a start lacks."""
        if self.counts.waiting_for:
            return f"particles {self.counts.waiting_for[:5]} are not seen"
        if self.counts.spacing != 1.0:
            period = self._dynamics.period
            return f"frames come {self.counts.spacing * period:.4g} s apart, the twin steps {period:g} s"
        return "no complete pair of frames yet"

    def reset(self) -> None:
        """End the run and forget all stamps; the next run starts from the tracker frames that follow."""
        self._state = self._before = None
        self.halted = None
        self._frames.clear()
        self._poses.clear()
        self._laps.clear()
        self._posed.clear()
        if self._delayed is not None:
            self._delayed.clear()
        self._pose_lap, self._time, self._begin = 0, (-1, 0), (-1, 0)

    def cancel(self) -> None:
        """End `advance` at its next step, within a long horizon too; for another thread, at the end of all."""
        self._cancelled = True

    def add_points(self, frame: PointFrame) -> None:
        """A tracker frame; without points, nothing is seen.

        Raises: TwinError if it has particles the twin does not know; InputError for its stamp (laps.py).
        """
        unknown = np.setdiff1d(frame.id, self._ids)
        if len(unknown):
            raise TwinError(
                "the particle ids of tracker/points do not match the twin",
                got=f"{len(unknown)} unknown ids, e.g. {unknown[:5].tolist()}",
                allowed=f"{len(self._ids)} ids, {self._ids.min()} to {self._ids.max()}",
                next_step="Give the twin that was identified on this object's tracks",
            )
        frame = dataclasses.replace(frame, position=self._calibration.correct_points(frame.position))
        self._take(TRACKER_POINTS, frame.stamp, lambda time: self._keep_frame(time, frame))

    def add_pose(self, pose: PoseFrame, closed: NDArray[np.bool_]) -> None:
        """A gripper pose. Where time goes back, or a hole has ended, it waits for the next one (in_line.py).

        Raises: InputError if the flags do not match, a held particle has no gripper, for its stamp (laps.py), or, once
        this one is taken, because the one before was out of line.
        """
        count = len(pose.position)
        if len(closed) != count:
            raise InputError(
                f"{GRIPPER_CLOSED} does not match {GRIPPER_POSE}", got=f"{len(closed)} flags", allowed=count
            )
        needed = max(self._held.values(), default=-1) + 1 if self._held else 0
        if count < needed:
            raise InputError(f"{GRIPPER_POSE}: too few grippers for 'held'", got=count, allowed=f"{needed} or more")
        position, rotation = self._calibration.correct_pose(pose.position, pose.rotation)
        late: InputError | None = None
        usable, wrong = self._posed.take(pose.stamp, (PoseFrame(pose.stamp, position, rotation), closed))
        for taken in usable:
            for p, c in [taken] if self._delayed is None else self._delayed.take(*taken):
                try:
                    self._take(GRIPPER_POSE, p.stamp, partial(self._keep_posed, p, c))
                    late = None
                except InputError as error:  # of two, the second confirms the first
                    late = error
        refused = wrong or late
        if refused is not None:
            raise refused

    def advance(self) -> Iterable[Prediction]:
        """Predictions that the data so far allow, oldest first."""
        raise NotImplementedError

    def _take(self, topic: str, stamp: int, keep: Callable[[Time], None]) -> None:
        for time, action in self._laps.take(topic, stamp, keep):
            action(time)

    def _keep_posed(self, pose: PoseFrame, closed: NDArray[np.bool_], time: Time) -> None:
        self._keep_pose(Pose(pose, closed, time[0]))

    def _keep_frame(self, time: Time, frame: PointFrame) -> None:
        while self._frames and self._frames[-1][0] >= time:  # their stamps were out of line
            self._frames.pop()
            self.counts.dropped_frames += 1
        self._frames.append((time, frame))
        if len(self._frames) > MAX_WAITING:
            self._frames.popleft()
            self.counts.dropped_frames += 1

    def _keep_pose(self, pose: Pose) -> None:
        while self._poses and self._poses[-1].time >= pose.time:  # their stamps were out of line
            self._poses.pop()
            self.counts.dropped_poses += 1
        if self._before is not None and self._before.time >= pose.time:
            self._end_run(pose)
        newest = self._poses[-1] if self._poses else self._before
        if newest is not None and newest.lap == pose.lap:
            self._spacings.append(pose.pose.stamp - newest.pose.stamp)
        self._begin = min(self._begin, pose.time)
        self.counts.jumps += pose.lap > self._pose_lap
        self._pose_lap = pose.lap
        self._poses.append(pose)
        if self._state is None and len(self._poses) > MAX_WAITING:
            self._before = self._poses.popleft()
            self.counts.dropped_poses += 1

    def _ends_run(self, pose: Pose) -> bool:
        if self._before is None:
            return False
        lap, stamp = self._before.time
        return pose.lap != lap or pose.pose.stamp - stamp > self._rules.max_gap * 1e9

    def _end_run(self, pose: Pose) -> None:
        if self._before is not None and pose.lap == self._before.lap:
            self.counts.gaps += 1
        self._state = self._before = None
        self.halted = None
        self._begin = (pose.lap, pose.pose.stamp - self._period // 2)

    def _reach(self, time: Time) -> Grip | None:
        """The gripper at a time where a run may start; poses before it are dropped.

        None: with no pose waiting, it may still come; else the poses begin later, and it never will.
        """
        near = self._near()
        while self._poses and self._poses[0].time < (time[0], time[1] - near):
            self._before = self._poses.popleft()
        if not self._poses:
            return None
        pose = self._poses[0]
        if pose.lap != time[0] or pose.pose.stamp - time[1] > near:
            if self._before is None or self._before.lap != time[0] or self._ends_run(pose):
                return None
            return self._between(self._before, pose, time[1])
        self._before = self._poses.popleft()
        return pose.grip()

    def _next_grip(self, pose: Pose) -> tuple[Grip, int, Pose] | None:
        """Gripper and stamp [ns] at the end of the next period, and the last pose before it; None: `pose` is earlier.

        `pose` has been taken from the waiting ones; if it lies beyond the period, it goes back to them.
        """
        assert self._before is not None
        next_stamp = self._time[1] + self._period
        offset = pose.pose.stamp - next_stamp
        near = self._near()
        if offset < -near:
            self.counts.unused_poses += 1
            self._before = pose
            return None
        if offset > near:
            self._poses.appendleft(pose)
            self.counts.interpolated += 1
            grip, stamp, last = self._between(self._before, pose, next_stamp), next_stamp, self._before
        else:
            grip, stamp, last = pose.grip(), pose.pose.stamp, pose
        previous, self._before = self._before, last
        return grip, stamp, previous

    def _near(self) -> int:
        """How far from a step's time [ns] a pose may lie to be the step. Poses that come once a period set the pace,
        whatever their clock; between those that come more or less often, a step lasts its period.
        """
        usual = float(np.median(self._spacings)) / self._period if self._spacings else 1.0
        return round((ON_GRID if abs(usual - 1.0) <= PACE else EXACT) * self._period)

    def _stepped(self, state: State, grip: Grip, stamp: int) -> State:
        """One step that must stay finite. Raises: DivergenceError; the run is over then."""
        return self._finite(lambda: self._dynamics.step(state, grip), stamp)

    def _finite(self, simulate: Callable[[], State], stamp: int) -> State:
        """A state at `stamp` that must be finite, no larger than what may be sent, and not in an explosion.

        Raises: DivergenceError; the run is over then.
        """
        try:
            after = simulate()
            extent = float((after.position.amax(dim=0) - after.position.amin(dim=0)).max())
            speed = float(after.velocity.norm(dim=-1).max())
            if extent <= LARGEST_EXTENT and speed <= LARGEST_SPEED:
                return after
            finite = math.isfinite(extent) and math.isfinite(speed)
            reason = f"{extent:.3g} m across, up to {speed:.3g} m/s" if finite else "not finite"
        except DivergenceError as error:
            reason = str(error)
        self._state = None
        self.halted = DivergenceError(
            f"the simulation diverged at stamp {stamp * 1e-9:.3f} s",
            got=reason,
            next_step="Check the twin and the gripper pose; ~/reset starts again",
        )
        raise self.halted

    def _ahead(self, stamp: int, state: State, grip: Grip, previous: Pose) -> Prediction | None:
        count = round(self._rules.horizon / self._dynamics.period)
        if count == 0:
            return Prediction(stamp, state, stamp, state)
        elapsed = max(stamp - previous.pose.stamp, 1) * 1e-9
        velocity = (grip.position - torch.as_tensor(previous.pose.position, dtype=torch.float32)) / elapsed
        ahead = state
        for k in range(1, count + 1):
            if self._cancelled:
                return None
            moved = Grip(grip.position + velocity * (k * self._dynamics.period), grip.rotation, grip.closed)
            ahead = self._stepped(ahead, moved, stamp + k * self._period)
        return Prediction(stamp, state, stamp + count * self._period, ahead)

    def _between(self, a: Pose, b: Pose, stamp: int) -> Grip:
        weight = (stamp - a.pose.stamp) / (b.pose.stamp - a.pose.stamp)
        position = a.pose.position + weight * (b.pose.position - a.pose.position)
        rotation = slerp(a.pose.rotation, b.pose.rotation, np.full(len(position), weight))
        return grip_of(position, rotation, a.closed)

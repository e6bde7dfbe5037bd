"""The measured gripper in the last moments, looked up at the time of a state."""

from __future__ import annotations

from collections import deque

import numpy as np

from pred_core.bag.align import slerp
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.in_line import InLine
from pred_core.bag.wire import GRIPPER_POSE, STATE_POINTS
from pred_core.errors import InputError
from pred_core.plan.plan import NS
from pred_core.types import Array

KEPT = 2.0  # [s]
AHEAD = 0.5  # [s] by which a pose may leave the others behind and be believed at once


class GripperPoses:
    """Poses in order of their stamps, all of the same grippers: plans in force are for just these. Not thread-safe."""

    def __init__(self) -> None:
        self._poses: deque[PoseFrame] = deque()
        self._line: InLine[PoseFrame] = InLine(GRIPPER_POSE, 0.0, AHEAD)

    def clear(self) -> None:
        """Forget all, and how many grippers there were."""
        self._poses.clear()
        self._line.clear()

    def add(self, pose: PoseFrame) -> None:
        """One more pose; two older than the last begin a new run.

        Raises: InputError for other grippers, or, once this one is taken, because the one before was out of line.
        """
        if self._poses:
            before, now = len(self._poses[-1].position), len(pose.position)
            if now != before:
                raise InputError(
                    f"{GRIPPER_POSE}: the number of grippers changed", got=now, allowed=f"{before} as before",
                    next_step="Check who publishes it; ~/reset accepts other grippers",
                )  # fmt: skip
        usable, wrong = self._line.take(pose.stamp, pose)
        for taken in usable:
            if self._poses and taken.stamp < self._poses[-1].stamp:  # a new run, or a clock set back
                self._poses.clear()
            self._poses.append(taken)
        while self._poses and self._poses[-1].stamp - self._poses[0].stamp > KEPT * NS:
            self._poses.popleft()
        if wrong is not None:
            raise wrong

    def at(self, stamp: int, most: float) -> tuple[Array, Array]:
        """Position (G, 3) [m] and rotation (G, 4) wxyz at `stamp` [ns], from poses at most `most` [s] away from it.

        Raises: InputError if there are none.
        """
        before = next((p for p in reversed(self._poses) if p.stamp <= stamp), None)
        after = next((p for p in self._poses if p.stamp >= stamp), None)
        nearest = before or after
        if before is not None and after is not None and after.stamp > before.stamp:
            share = (stamp - before.stamp) / (after.stamp - before.stamp)
            gap = max(stamp - before.stamp, after.stamp - stamp) / NS
            position = before.position + share * (after.position - before.position)
            rotation = slerp(before.rotation, after.rotation, np.full(len(position), share))
        else:
            gap = float("inf") if nearest is None else abs(nearest.stamp - stamp) / NS
            position, rotation = (nearest.position, nearest.rotation) if nearest else (np.zeros((0, 3)),) * 2
        if gap > most:
            raise InputError(
                f"no {GRIPPER_POSE} at the stamp of {STATE_POINTS}",
                got="none yet" if nearest is None else f"{gap:.3f} s away", allowed=f"{most:g} s",
                next_step="Check that the arm publishes and clocks agree",
            )  # fmt: skip
        return position, rotation

"""Tracks that are older than their stamps say: the gripper pose that belongs to a tracker stamp is an earlier one.

Stamps stay the tracker's, so that poses and tracks still come on one grid; each pose is replaced by what the gripper
did `delay` before. Nothing is predicted later for it: the earlier pose is known already.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.align import slerp
from pred_core.bag.grippers import PoseFrame

Posed = tuple[PoseFrame, NDArray[np.bool_]]  # a pose and the closed flags (G,) of the grippers


class DelayedPoses:
    """Feed poses in order of arrival; each call gives those that are known now."""

    def __init__(self, delay: float, max_gap: float):
        self._delay, self._max_gap = round(delay * 1e9), round(max_gap * 1e9)  # [ns]
        self._past: deque[Posed] = deque()
        self._waiting: deque[int] = deque()  # [ns] stamps that have no pose yet

    def clear(self) -> None:
        """Forget what came before."""
        self._past.clear()
        self._waiting.clear()

    def take(self, pose: PoseFrame, closed: NDArray[np.bool_]) -> list[Posed]:
        """Poses with the stamps of the tracker. The first ones of a run are lost: nothing is known before them."""
        if self._past and not 0 < pose.stamp - self._past[-1][0].stamp <= self._max_gap:
            self.clear()
        self._past.append((pose, closed))
        self._waiting.append(pose.stamp)
        known = []
        while self._waiting and self._waiting[0] - self._delay <= pose.stamp:
            stamp = self._waiting.popleft()
            at = stamp - self._delay
            while len(self._past) > 1 and self._past[1][0].stamp <= at:
                self._past.popleft()
            if self._past[0][0].stamp <= at:
                known.append(self._at(at, stamp))
        return known

    def _at(self, at: int, stamp: int) -> Posed:
        """The pose at `at` [ns], stamped `stamp`; the oldest pose kept is the last one not after it."""
        before, closed = self._past[0]
        if before.stamp == at or len(self._past) == 1:
            return PoseFrame(stamp, before.position, before.rotation), closed
        after, closed_after = self._past[1]
        w = (at - before.stamp) / (after.stamp - before.stamp)
        position = before.position + w * (after.position - before.position)
        rotation = slerp(before.rotation, after.rotation, np.full(len(position), w))
        return PoseFrame(stamp, position, rotation), closed if w < 0.5 else closed_after

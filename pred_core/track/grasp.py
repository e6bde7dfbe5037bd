"""The gripper as a measurement: where it holds the object, the object moves with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pred_core.bag.in_line import InLine
from pred_core.bag.wire import GRIPPER_POSE
from pred_core.config import setting
from pred_core.errors import InputError
from pred_core.types import Array

KEPT = 2_000_000_000  # [ns] of gripper poses
AHEAD = 0.5  # [s] by which a pose may leave the others behind and be believed at once


@dataclass(frozen=True)
class GraspConfig:
    """How a grasp binds."""

    radius: float = setting(0.03, unit="m", low=0.0, high=0.3, doc="particles this near to a closing gripper are held")
    sigma: float = setting(0.0015, unit="m", low=1e-4, high=0.05, doc="of a held particle in the gripper's frame")
    slip: float = setting(0.03, unit="m", low=1e-3, high=0.3, doc="the object seen farther off by this has slipped out")
    patience: float = setting(0.2, unit="s", low=0.0, high=10.0, doc="for so long before the grasp is given up")


class GripperPath:
    """Measured gripper poses, looked up at capture times."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._poses: list[tuple[Array, Array]] = []
        self._line: InLine[tuple[int, Array, Array]] = InLine(GRIPPER_POSE, 0.0, AHEAD)

    def add(self, stamp: int, position: Array, rotation: Array) -> None:
        """Poses (G, 3) [m] and (G, 4) wxyz at `stamp` [ns]; two older than the last begin a new recording.

        Raises: InputError if not finite, or, once this one is taken, because the one before was out of line.
        """
        if not (np.isfinite(position).all() and np.isfinite(rotation).all()):
            raise InputError("gripper pose is not finite", next_step="Check the source of gripper/pose")
        usable, wrong = self._line.take(stamp, (stamp, position, rotation))
        for taken in usable:
            self._keep(*taken)
        if wrong is not None:
            raise wrong

    def _keep(self, stamp: int, position: Array, rotation: Array) -> None:
        if self._stamps and (stamp < self._stamps[-1] or position.shape != self._poses[-1][0].shape):
            self._stamps, self._poses = [], []  # a new recording
        if self._stamps and stamp == self._stamps[-1]:
            return
        self._stamps.append(stamp)
        self._poses.append((np.asarray(position, float), _matrices(np.asarray(rotation, float))))
        while self._stamps[-1] - self._stamps[0] > KEPT:
            del self._stamps[0], self._poses[0]

    def expected(self, stamp: int, silent: float) -> bool:
        """Whether poses of `stamp` [ns] are still to come: the newest is less than `silent` [s] away from it."""
        return bool(self._stamps) and abs(stamp - self._stamps[-1]) * 1e-9 < silent and self.at(stamp) is None

    def at(self, stamp: int, late: float = 0.1) -> tuple[Array, Array] | None:
        """Position (G, 3) and rotation matrices (G, 3, 3) at `stamp` [ns]: linear between poses, the newest one for
        `late` [s] after it, else None."""
        if not self._stamps or stamp < self._stamps[0] or (stamp - self._stamps[-1]) * 1e-9 > late:
            return None
        after = int(np.searchsorted(self._stamps, stamp))
        if after == 0 or after == len(self._stamps):
            return self._poses[min(after, len(self._stamps) - 1)]
        before, next_ = self._poses[after - 1], self._poses[after]
        share = (stamp - self._stamps[after - 1]) / (self._stamps[after] - self._stamps[after - 1])
        blend = (1 - share) * before[1] + share * next_[1]
        u, _, v = np.linalg.svd(blend)
        return (1 - share) * before[0] + share * next_[0], u @ v


class Grasp:
    """Which particles each gripper holds, in its own frame."""

    def __init__(self, config: GraspConfig):
        self.config = config
        self.held: NDArray[np.int64] = np.zeros(0, np.int64)  # (P,) gripper or -1
        self._local: Array = np.zeros((0, 3))
        self.slipped = False  # what was held is not any more
        self._usual = 0.0  # [m] from the held particles to the nearest point seen, when they were bound
        self._off_since: int | None = None

    def bind(self, position: Array, poses: tuple[Array, Array] | None, closed: NDArray[np.bool_]) -> None:
        """Hold the particles (P, 3) [m] that are near to closed grippers now, and no others."""
        self.held = np.full(len(position), -1, np.int64)
        self._local = np.zeros_like(position)
        self._usual, self._off_since, self.slipped = -1.0, None, False
        if poses is None:
            return
        for gripper, (place, turn) in enumerate(zip(*poses, strict=True)):
            if gripper >= len(closed) or not closed[gripper]:
                continue
            near = (np.linalg.norm(position - place, axis=-1) < self.config.radius) & (self.held < 0)
            self.held[near] = gripper
            self._local[near] = (position[near] - place) @ turn

    def targets(self, poses: tuple[Array, Array] | None) -> tuple[NDArray[np.int64], Array]:
        """Held particles and where they are (H, 3) [m] now."""
        held = np.flatnonzero(self.held >= 0)
        if poses is None or not len(held):
            return np.zeros(0, np.int64), np.zeros((0, 3))
        place, turn = poses
        index = self.held[held]
        return held, place[index] + np.einsum("hab,hb->ha", turn[index], self._local[held])

    def watch(self, place: Array, points: Array, stamp: int) -> bool:
        """True if the object has slipped out: for some time nothing is seen near the held particles' places (H, 3).

        points (M, 3) [m] are what the cameras see of the object. The first call after `bind` sets what is usual: jaws
        hide what they hold.
        """
        if not len(place) or not len(points):
            return False
        gap = float(cKDTree(points).query(place)[0].min())
        if self._usual < 0.0:
            self._usual = gap
        if gap < self._usual + self.config.slip:
            self._off_since = None
            return False
        self._off_since = stamp if self._off_since is None else self._off_since
        return (stamp - self._off_since) * 1e-9 >= self.config.patience

    def release(self) -> None:
        """The object has slipped out: hold nothing."""
        self.held = np.full_like(self.held, -1)
        self.slipped = True


def _matrices(q: Array) -> Array:
    """Rotation matrices (G, 3, 3) of unit quaternions (G, 4) wxyz."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)

"""Is the rope through the slot? Paper IV-F: entirely through, the gripper below the slot's height; made exact here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import InputError
from pred_core.plant.live.slot import SlotConfig

Array = NDArray[np.float64]
BELOW_TOP = 0.01  # [m] the rope in the slot lies at least this far below the top of the posts
BEYOND = 0.02  # [m] of rope on each side


@dataclass(frozen=True)
class Passage:
    """How the rope goes through the slot."""

    inside: bool  # all rope within the posts' thickness is in the gap and low enough, and some is
    crossings: int  # how often the rope goes through the plane in the middle of the posts
    before: float  # [m] of rope on the near side, beyond the posts' thickness
    behind: float  # [m] of rope on the far side
    gripper_low: bool  # the gripper is below the top of the posts

    @property
    def success(self) -> bool:
        """All of it: inside, an odd number of crossings, rope on both sides, gripper low."""
        return self.threaded and self.gripper_low

    @property
    def threaded(self) -> bool:
        """The rope's part of it."""
        return self.inside and self.crossings % 2 == 1 and min(self.before, self.behind) >= BEYOND


def judge_passage(rope: Array, gripper: Array, slot: SlotConfig) -> Passage:
    """rope (N, 3): points along the rope's middle; gripper (3,): tool centre; both [m] world.

    The rope is the polyline of its points. Raises: InputError unless there are two points or more, all finite.
    """
    rope, gripper = np.asarray(rope, float), np.asarray(gripper, float)
    if rope.ndim != 2 or rope.shape[1] != 3 or len(rope) < 2 or not np.isfinite(rope).all():
        raise InputError("rope", got=f"shape {rope.shape}", allowed="(N, 3) finite points, N >= 2")
    if gripper.shape != (3,) or not np.isfinite(gripper).all():
        raise InputError("gripper", got=gripper.tolist(), allowed="one finite point")
    points = slot.to_slot(rope)
    half = 0.5 * slot.thickness
    clipped = [c for a, b in zip(points[:-1], points[1:], strict=True) if (c := _within(a, b, -half, half)) is not None]
    # The allowed cross-section is convex, so a piece lies in it when both of its ends do.
    inside = bool(clipped) and all(
        (np.abs(c[:, 1]) <= 0.5 * slot.gap).all() and (c[:, 2] <= slot.height - BELOW_TOP).all() for c in clipped
    )
    side = points[:, 0] >= 0.0
    return Passage(
        inside=inside,
        crossings=int(np.count_nonzero(side[1:] != side[:-1])),
        before=_length_within(points, -np.inf, -half),
        behind=_length_within(points, half, np.inf),
        gripper_low=bool(slot.to_slot(gripper)[2] < slot.height),
    )


def _length_within(points: Array, low: float, high: float) -> float:
    """Length [m] of the polyline (N, 3) with low <= x <= high."""
    total = 0.0
    for a, b in zip(points[:-1], points[1:], strict=True):
        piece = _within(a, b, low, high)
        if piece is not None:
            total += float(np.linalg.norm(piece[1] - piece[0]))
    return total


def _within(a: Array, b: Array, low: float, high: float) -> Array | None:
    """The ends (2, 3) of the part of the segment a b with low <= x <= high; None if there is none."""
    if max(a[0], b[0]) < low or min(a[0], b[0]) > high:
        return None
    run = b[0] - a[0]
    if run == 0.0:
        return np.stack((a, b))
    shares = np.sort(np.array([(low - a[0]) / run, (high - a[0]) / run]))
    begin, end = max(shares[0], 0.0), min(shares[1], 1.0)
    return np.stack((a + begin * (b - a), a + end * (b - a)))

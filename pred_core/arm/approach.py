"""A straight way to where a motion begins, before it: timed poses that one arm can follow in one plan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.arm.orientation import Quaternion, angle_between, slerp

Array = NDArray[np.float64]
SPACING = 0.1  # [s] between two points of the way
TURN = 0.5  # [rad/s] on the way


@dataclass(frozen=True)
class TimedPoses:
    """Poses of one gripper in `world`, the first at time 0."""

    times: Array  # (K,) [s], increasing
    position: Array  # (K, 3) [m]
    rotation: Array  # (K, 4) wxyz


def with_approach(motion: TimedPoses, here: Array, turned: Quaternion, speed: float, rest: float) -> TimedPoses:
    """From `here` (3,) [m], wxyz, straight to the first pose with at most `speed` [m/s], `rest` [s] there, the motion.

    The way begins and ends at rest: its share is (1 - cos)/2 of the time, whose largest speed is pi/2 of the mean.
    """
    first, goal = motion.position[0], _wxyz(motion.rotation[0])
    way, angle = float(np.linalg.norm(first - here)), angle_between(turned, goal)
    seconds = 0.5 * math.pi * max(way / speed, angle / TURN)
    count = max(2, math.ceil(seconds / SPACING))
    parts = np.linspace(0.0, 1.0, count + 1)
    times = parts * max(seconds, 2 * SPACING)
    shares = 0.5 - 0.5 * np.cos(np.pi * parts)
    position = here + shares[:, None] * (first - here)
    rotation = np.array([slerp(turned, goal, float(s)) for s in shares])
    begin = float(times[-1]) + max(rest, SPACING)
    return TimedPoses(
        np.concatenate((times, begin + motion.times - motion.times[0])),
        np.concatenate((position, motion.position)),
        np.concatenate((rotation, motion.rotation)),
    )


def _wxyz(row: Array) -> Quaternion:
    return (float(row[0]), float(row[1]), float(row[2]), float(row[3]))

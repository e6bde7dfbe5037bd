"""Motions worth a try that noise around a mean hardly finds: lift, carry across, put down at a point of the goal.

Noise on velocity knots rarely goes up, over an obstacle and down again within one plan. A share of the samples of
every iteration is therefore drawn as a way to a point of the goal cloud, over a random height. They are judged like
every other sample; nothing about the obstacle is used. A departure from the paper's MPPI (III-E), 0 switches it off.
"""

from __future__ import annotations

import numpy as np

from pred_core.plan.knots import KnotLimits
from pred_core.types import Array

AROUND = 0.03  # [m] standard deviation of the end about a point of the goal
RISE, FALL = (0.0, 0.35), (0.65, 1.0)  # shares of the way across at which the lift and the descent are


def draw_ways(
    goal: Array, start: Array, count: int, speed: float, limits: KnotLimits, generator: np.random.Generator
) -> Array:
    """Free velocity knots (M, K, G, 4) [m/s], [rad/s] of `count` ways of grippers at start (G, 3) [m], without turns.

    goal (Q, 3) [m] world; a way that is too long for the horizon at `speed` [m/s] is cut off.
    """
    grippers = len(start)
    ends = goal[generator.integers(0, len(goal), (count, grippers))]
    ends = np.clip(ends + AROUND * generator.standard_normal(ends.shape), limits.low, limits.high)
    top = np.maximum(start[:, 2], ends[..., 2])
    height = top + generator.random(top.shape) * np.maximum(limits.high[2] - top, 0.0)
    rise, fall = (generator.uniform(*span, (count, grippers)) for span in (RISE, FALL))
    slower = generator.uniform(0.6, 1.0, (count, grippers))
    knots = np.zeros((limits.free, count, grippers, 4))
    times = limits.spacing * np.arange(limits.free + 1)
    for k in range(count):
        for g in range(grippers):
            across = ends[k, g] - start[g]
            corners = start[g] + np.array([[0.0], [rise[k, g]], [fall[k, g]], [1.0]]) * across
            corners[1:3, 2] = height[k, g]
            gone = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))))
            at = slower[k, g] * speed * times
            place = np.stack([np.interp(at, gone, corners[:, axis]) for axis in range(3)], axis=1)
            knots[:, k, g, :3] = np.diff(place, axis=0) / limits.spacing
    return knots

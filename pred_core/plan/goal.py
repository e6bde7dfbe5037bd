"""The goal cloud: what makes it usable, and how many of its points are used."""

from __future__ import annotations

import numpy as np

from pred_core.bag.clouds import check_extent
from pred_core.errors import BagError, InputError
from pred_core.types import Array, Body, Scene

MOST_POINTS = 1500  # of a goal that are compared; more are thinned evenly
UNDER_TABLE = 0.02  # [m] a goal may lie below the table: calibration errors of cameras
LARGER = 1.25  # times the object's own size


def check_goal(goal: Array, body: Body, scene: Scene, low: Array, high: Array) -> Array:
    """The goal (Q, 3) [m] world as the planner uses it.

    low, high: (3,) [m] the gripper's workspace. Raises: InputError for an empty goal, points that are not finite or
    implausibly far, a goal larger than the object, under the table, or out of the reach of an object whose gripper
    stays in the workspace.
    """
    points = np.asarray(goal, float)
    if points.ndim != 2 or points.shape[1:] != (3,):
        raise InputError("goal", got=f"an array of shape {points.shape}", allowed="(Q, 3)")
    if not len(points):
        raise InputError("the goal is empty", got="no points", allowed="at least one", next_step="Record a goal cloud")
    bad = ~np.isfinite(points).all(1)
    if bad.any():
        raise InputError("the goal has points that are not finite", got=f"{int(bad.sum())} of {len(points)}")
    try:
        check_extent(points, "goal")
    except BagError as error:
        raise InputError(str(error)) from error
    reach = size_of(body)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    if size > LARGER * reach:
        raise InputError("the goal is larger than the object", got=f"{size:.2f} m across", allowed=f"{reach:.2f} m",
                         next_step="Take the table and the robot out of the goal cloud")  # fmt: skip
    if scene.ground is not None and float(points[:, 2].min()) < scene.ground - UNDER_TABLE:
        raise InputError(
            "the goal lies under the table", got=f"z {points[:, 2].min():.3f} m", allowed=f"{scene.ground:g} m or more",
            next_step="Check the calibration of the cameras",
        )  # fmt: skip
    outside = np.maximum(np.maximum(low - points, points - high), 0.0)
    farthest = float(np.linalg.norm(outside, axis=1).max())
    if farthest > LARGER * reach:
        raise InputError(
            "the goal is out of reach", got=f"{farthest:.2f} m outside the gripper's workspace",
            allowed=f"{reach:.2f} m, the size of the object", next_step="Move the goal or widen the workspace",
        )  # fmt: skip
    return thinned(points, MOST_POINTS)


def size_of(body: Body) -> float:
    """[m] the farthest two particles of an object can be apart: a line's length, else its diagonal at rest."""
    if body.kind == "line":
        line = body.rest_position[np.argsort(body.arc, kind="stable")]
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return float(np.linalg.norm(np.ptp(body.rest_position, axis=0)))


def thinned(points: Array, most: int) -> Array:
    """At most `most` of points (Q, 3): one in each cell of a grid, as fine as it may be."""
    if len(points) <= most:
        return points
    low, size = points.min(axis=0), float(np.ptp(points, axis=0).max())
    fine, coarse = size / len(points), 2.0 * size  # a cell that keeps too many, one that keeps a single point
    kept = points[:1]
    for _ in range(20):
        cell = float(np.sqrt(fine * coarse))
        i, j, k = np.floor((points - low) / cell).astype(np.int64).T
        side = int(size / cell) + 1
        _, first = np.unique((i * side + j) * side + k, return_index=True)
        if len(first) > most:
            fine = cell
        else:
            coarse, kept = cell, points[np.sort(first)]
    return kept

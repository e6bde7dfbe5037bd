"""What grippers say of a line: which of its ends is the first, and where an end lies that their jaws hide."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pred_core.track.line_config import LineConfig
from pred_core.track.line_fit import Anchors
from pred_core.types import Array

Poses = tuple[Array, Array]  # (G, 3) [m] and (G, 3, 3), world_from_gripper
ENDS = 2


def closed_grips(poses: Poses | None, closed: NDArray[np.bool_]) -> Array:
    """(G, 3) [m] tool centres of the closed grippers."""
    return np.zeros((0, 3)) if poses is None else poses[0][: len(closed)][closed[: len(poses[0])]]


def from_first_end(path: Array, grips: Array, config: LineConfig) -> Array:
    """A path (K, 3) [m] whose first end is the nearest to a closed gripper, else the one of smaller x.

    What the jaws hide of it is added.
    """
    if not len(grips):
        return path if path[0, 0] <= path[-1, 0] else path[::-1]
    away = np.linalg.norm(path[[0, -1]][:, None] - grips[None], axis=-1)  # (2, G)
    path = path if away[0].min() <= away[1].min() else path[::-1]
    for gripper in grips[:ENDS]:
        for end in (0, -1):
            gap = float(np.linalg.norm(path[end] - gripper))
            if config.start.voxel < gap < config.bridge:
                path = np.concatenate([gripper[None], path] if end == 0 else [path, gripper[None]])
    return path


def ends_in_tools(nodes: Array, grips: Array, config: LineConfig) -> Anchors:
    """A held end is in the tool centre, which the jaws hide. Nodes (N, 3) [m]."""
    target, information = nodes.copy(), np.zeros((len(nodes), 3, 3))
    for gripper in grips if config.end_in_tool else ():
        end = min((0, -1), key=lambda e: float(np.linalg.norm(nodes[e] - gripper)))  # noqa: B023 (used at once)
        if np.linalg.norm(nodes[end] - gripper) < config.grasp.radius:
            target[end], information[end] = gripper, np.eye(3) / config.grasp.sigma**2
    return Anchors(target, information)

"""Who holds what when a live run starts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.episode import GRASP_RADIUS
from pred_core.types import Grip


def held_at_start(
    ids: NDArray[np.uint32], told: Mapping[int, int] | None, position: NDArray[np.float64], seen: Grip, start: Grip
) -> NDArray[np.int32]:
    """(N,) gripper index of every particle, -1: free. A gripper that is open at the start holds nothing, whatever is
    `told` (particle id -> gripper), just as one that opens later lets go.

    told: None: the particles within GRASP_RADIUS of a gripper that was closed when they were seen.
    position (N, 3) [m]: where that was. seen, start: the grippers at that time, and when the run starts.
    """
    held = np.full(len(ids), -1, np.int32)
    if told is not None:
        for particle, gripper in told.items():
            held[ids == particle] = gripper
    else:
        distance = np.linalg.norm(position[:, None] - seen.position.double().numpy()[None], axis=-1)
        distance[:, ~seen.closed.numpy()] = np.inf
        near = distance.min(axis=1) <= GRASP_RADIUS
        held[near] = distance.argmin(axis=1)[near]
    held[(held >= 0) & ~start.closed.numpy()[held]] = -1
    return held

"""Two-sided chamfer distance to the goal cloud (paper IV-F): on the way, and at the end."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.metrics.chamfer_batch import chamfer_two_sided_batch
from pred_core.plan.rollouts import Rollouts
from pred_core.types import Array


class GoalCost:
    """`way` x mean over the looked-at steps + `end` x last step of `chamfer_two_sided_unsquared` [m].

    Two-sided: one side alone is satisfied by an object that is crumpled onto a part of the goal.
    """

    name = "goal"

    def __init__(self, goal: Array, particles: NDArray[np.int64] | None, way: float, end: float):
        """goal (Q, 3) [m] world; particles: indices of those that a camera could see, None: all; weights [1/m]."""
        self._goal = torch.as_tensor(goal, dtype=torch.float32)[None]
        self._particles = None if particles is None else torch.as_tensor(np.asarray(particles), dtype=torch.long)
        self._way, self._end = way, end

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        distance = self.distance(rollouts.position[list(rollouts.frames)])
        return self._way * distance.mean(0) + self._end * distance[-1]

    def distance(self, position: Tensor) -> Tensor:
        """Chamfer distances (...) [m] of objects (..., N, 3) [m]."""
        if self._particles is not None:
            position = position.index_select(-2, self._particles.to(position.device))
        flat = position.reshape(-1, *position.shape[-2:]).float().contiguous()
        return chamfer_two_sided_batch(flat, self._goal.to(position.device)).reshape(position.shape[:-2])

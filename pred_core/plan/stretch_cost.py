"""Stretch: a plan may not pull the object longer than it is."""

from __future__ import annotations

import torch
from torch import Tensor

from pred_core.plan.rollouts import Rollouts
from pred_core.types import Body


class StretchCost:
    """`weight` x strain of the most stretched spring beyond `most`, mean over the looked-at steps."""

    name = "stretch"

    def __init__(self, body: Body, weight: float, most: float):
        """most: strain that costs nothing."""
        self._springs = torch.as_tensor(body.springs, dtype=torch.long)
        self._rest = torch.as_tensor(body.rest_length, dtype=torch.float32)
        self._weight, self._most = weight, most

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        if not len(self._springs):
            return rollouts.position.new_zeros(rollouts.position.shape[1])
        x = rollouts.position[list(rollouts.frames)]
        springs = self._springs.to(x.device)
        length = (x.index_select(-2, springs[:, 1]) - x.index_select(-2, springs[:, 0])).norm(dim=-1)
        strain = length / self._rest.to(x.device) - 1.0
        return self._weight * (strain.amax(-1) - self._most).clamp_min(0.0).mean(0)

"""What a motion costs: a sum of small plug-ins, each with a name and its weight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from pred_core.errors import ConfigError
from pred_core.plan.rollouts import Rollouts
from pred_core.types import Array


class Cost(Protocol):
    """One reason to prefer a motion. Never sees a motion that diverged."""

    @property
    def name(self) -> str:
        """Unique among the costs of an objective."""

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """Weighted cost (K,) of each motion, 0 or more, on the device of the rollouts."""


class Objective:
    """The sum of some costs."""

    def __init__(self, costs: Sequence[Cost]):
        """Raises: ConfigError for no cost, or two of one name."""
        self.costs = tuple(costs)
        names = [c.name for c in self.costs]
        if not names or len(set(names)) != len(names):
            raise ConfigError("costs of the planner", got=names, allowed="one or more, each name once")

    def __call__(self, rollouts: Rollouts) -> tuple[Array, dict[str, Array]]:
        """Total (K,) and each cost (K,) by name; infinite for a motion that diverged."""
        fine = rollouts.finite()
        whole = bool(fine.all())
        judged = rollouts if whole else rollouts.select(torch.nonzero(fine).flatten())
        chosen = fine.cpu().numpy()
        total = np.zeros(len(chosen))
        parts: dict[str, Array] = {}
        for cost in self.costs:
            values = np.full(len(chosen), np.inf)
            if chosen.any():
                values[chosen] = cost(judged).double().cpu().numpy()
            parts[cost.name] = values
            total = total + values
        return total, parts

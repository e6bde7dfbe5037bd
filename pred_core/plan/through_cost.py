"""A line shall lead through a slot as its goal does, whatever the rest of it does meanwhile.

Chamfer distance alone does not ask for it: where the goal's free end lies elsewhere than the line's own, a line that
stays on one side and copies the goal's larger part there is nearer to the goal, over any plan of a few seconds, than
one that is led through first. A departure from the paper, whose cost is the chamfer distance (IV-F).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pred_core.plan.goal import size_of
from pred_core.plan.passage_cost import SlotLine
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.slot import Slot
from pred_core.types import Array, Body

BEYOND = 0.02  # [m] to either side, of place and of line; a goal with less does not lead through


class ThroughCost:
    """`weight` x (1 - p), the mean of its mean over the looked-at steps and of its last; p: how far it is through.

    With f the share of the line beyond the slot's plane, f* that of the goal's points, d the distance of the farthest
    crossing from the gap's opening [m] and h the posts' height [m]

        p = max(0, 1 - |f - f*| / min(f*, 1 - f*)) max(0, 1 - d / h)

    if the line's ends lie on different sides, else 0; 1 is a line that is through as far as the goal is. A goal that
    lies on one side only, in the plane, or crosses it beside the gap asks for nothing.
    """

    name = "through"

    def __init__(self, slot: Slot, body: Body, goal: Array, weight: float):
        """goal (Q, 3) [m] world. Raises: ConfigError unless the body is a line."""
        self._line = SlotLine(slot, body)
        pieces = np.diff(np.sort(body.arc))
        self._pieces = torch.as_tensor(pieces / pieces.sum(), dtype=torch.float32)
        local = (goal - slot.foot) @ slot.axes.T  # (Q, 3) through, across, up
        self._wanted = float((local[:, 0] >= 0.0).mean())
        self._least = min(self._wanted, 1.0 - self._wanted)
        self._asked = self._least * size_of(body) >= BEYOND and _through(local, slot)
        self._height, self._weight = slot.height, weight

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        position = rollouts.position[list(rollouts.frames)]
        if not self._asked:
            return position.new_zeros(position.shape[1])
        lacks = 1.0 - self.passed(position)
        return 0.5 * self._weight * (lacks.mean(0) + lacks[-1])

    def passed(self, position: Tensor) -> Tensor:
        """p (...) of particles (..., N, 3) [m] world, 0 to 1."""
        found = self._line.crossings(position)
        beyond = (found.through >= 0.0).to(position)
        a, b = beyond[..., :-1], beyond[..., 1:]
        # A segment that crosses lies beyond with its part before the crossing, or with the rest.
        f = torch.where(found.crosses, a * found.share + b * (1.0 - found.share), a) @ self._pieces.to(position.device)
        apart = beyond[..., 0] != beyond[..., -1]
        amount = (1.0 - (f - self._wanted).abs() / self._least).clamp_min(0.0)
        return amount * (1.0 - found.off / self._height).clamp_min(0.0) * apart.to(amount)


def _through(goal: Array, slot: Slot) -> bool:
    """Whether a goal (Q, 3) [m], in the slot's axes, lies on both sides and, at the plane, in the opening."""
    through = goal[:, 0]
    if through.max() < BEYOND or through.min() > -BEYOND:
        return False
    near = goal[np.abs(through) <= max(BEYOND, np.abs(through).min())]
    across, height = np.median(np.abs(near[:, 1])), np.median(near[:, 2])
    return bool(across <= 0.5 * slot.gap and height <= slot.height)

"""A line that crosses the plane of a slot shall do so in its gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.errors import ConfigError
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.slot import Slot
from pred_core.types import Body

BELOW = 0.01  # [m] under the posts' top edge, so that the line cannot slip out


@dataclass(frozen=True)
class Crossings:
    """Where lines cross the plane in the middle of the posts; leading axes (...) are steps and motions."""

    through: Tensor  # (..., N) [m] of the particles in order, beyond the plane along the way through the gap
    share: Tensor  # (..., N - 1) of each segment that lies before its crossing
    crosses: Tensor  # (..., N - 1) bool
    off: Tensor  # (...) [m] of the farthest crossing from the gap's opening; 0 without any


class SlotLine:
    """A line and a slot. The opening reaches from the foot to 1 cm below the top, narrowed by the line's radius."""

    def __init__(self, slot: Slot, body: Body):
        """Raises: ConfigError unless the body is a line."""
        if body.kind != "line":
            raise ConfigError("a cost of the slot", got=f"a body of kind {body.kind}", allowed="a line")
        self._order = torch.as_tensor(np.argsort(body.arc, kind="stable"), dtype=torch.long)
        self._axes = torch.as_tensor(slot.axes, dtype=torch.float32)
        self._foot = torch.as_tensor(slot.foot, dtype=torch.float32)
        self._half = max(0.5 * slot.gap - body.radius, 0.0)
        self._top = slot.height - BELOW

    def crossings(self, position: Tensor) -> Crossings:
        """Of particles (..., N, 3) [m] world."""
        x = position.index_select(-2, self._order.to(position.device))
        local = (x - self._foot.to(x.device)) @ self._axes.to(x.device).T  # through, across, up
        a, b = local[..., :-1, :], local[..., 1:, :]
        crosses = (a[..., 0] < 0.0) != (b[..., 0] < 0.0)
        way = b[..., 0] - a[..., 0]
        share = -a[..., 0] / torch.where(crosses, way, torch.ones_like(way))
        at = a + share[..., None] * (b - a)
        beside = (at[..., 1].abs() - self._half).clamp_min(0.0)
        above = (at[..., 2] - self._top).clamp_min(0.0)
        off = torch.where(crosses, torch.hypot(beside, above), torch.zeros_like(beside))
        return Crossings(local[..., 0], share, crosses, off.amax(-1))


class PassageCost:
    """`weight` x distance of the farthest crossing from the gap's opening [m], mean over the looked-at steps.

    A line that does not cross the plane costs nothing here: the goal, and through_cost.py, make it cross.
    """

    name = "passage"

    def __init__(self, slot: Slot, body: Body, weight: float):
        """Raises: ConfigError unless the body is a line."""
        self._line, self._weight = SlotLine(slot, body), weight

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        return self._weight * self._line.crossings(rollouts.position[list(rollouts.frames)]).off.mean(0)

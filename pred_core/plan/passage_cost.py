"""A line that crosses the plane of a slot shall do so in its gap."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pred_core.errors import ConfigError
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.slot import Slot
from pred_core.types import Body

BELOW = 0.01  # [m] under the posts' top edge, so that the line cannot slip out


class PassageCost:
    """`weight` x distance of the farthest crossing from the gap's opening [m], mean over the looked-at steps.

    The opening reaches from the foot to 1 cm below the top, narrowed by the line's radius on both sides. A line that
    does not cross the plane costs nothing: the goal makes it cross.
    """

    name = "passage"

    def __init__(self, slot: Slot, body: Body, weight: float):
        """Raises: ConfigError unless the body is a line."""
        if body.kind != "line":
            raise ConfigError("the passage cost", got=f"a body of kind {body.kind}", allowed="a line")
        self._order = torch.as_tensor(np.argsort(body.arc, kind="stable"), dtype=torch.long)
        self._axes = torch.as_tensor(slot.axes, dtype=torch.float32)
        self._foot = torch.as_tensor(slot.foot, dtype=torch.float32)
        self._half = max(0.5 * slot.gap - body.radius, 0.0)
        self._top = slot.height - BELOW
        self._weight = weight

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        x = rollouts.position[list(rollouts.frames)]
        x = x.index_select(-2, self._order.to(x.device))
        local = (x - self._foot.to(x.device)) @ self._axes.to(x.device).T  # through, across, up
        a, b = local[..., :-1, :], local[..., 1:, :]
        crosses = (a[..., 0] < 0.0) != (b[..., 0] < 0.0)
        way = b[..., 0] - a[..., 0]
        share = -a[..., 0] / torch.where(crosses, way, torch.ones_like(way))
        at = a + share[..., None] * (b - a)
        beside = (at[..., 1].abs() - self._half).clamp_min(0.0)
        above = (at[..., 2] - self._top).clamp_min(0.0)
        off = torch.where(crosses, torch.hypot(beside, above), torch.zeros_like(beside))
        return self._weight * off.amax(-1).mean(0)

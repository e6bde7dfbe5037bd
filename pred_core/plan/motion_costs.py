"""Costs of the gripper's motion itself: smoothness and workspace."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pred_core.plan.rollouts import Rollouts
from pred_core.types import Array

LEVER = 0.1  # [m] at which an angular acceleration counts as an acceleration


class SmoothnessCost:
    """`weight` x root mean square acceleration of all grippers [m/s^2], exact for the curve."""

    name = "smoothness"

    def __init__(self, weight: float):
        """weight [s^2/m]."""
        self._weight = weight

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        # Acceleration is linear between its values at the knots: the mean of its square is that of the chord.
        a = np.diff(rollouts.knots, axis=0) / rollouts.spacing  # (S + 1, K, G, 4)
        a = a * np.array([1.0, 1.0, 1.0, LEVER])
        square = (a[:-1] ** 2 + a[:-1] * a[1:] + a[1:] ** 2) / 3.0
        mean = square.sum(axis=(2, 3)).mean(axis=0)
        return self._weight * torch.as_tensor(np.sqrt(mean), dtype=torch.float32, device=rollouts.position.device)


class WorkspaceCost:
    """`weight` x way of the farthest gripper out of the box [m], mean over all steps.

    Motions are kept in the box already (knots.py); this brings back a gripper that begins outside.
    """

    name = "workspace"

    def __init__(self, low: Array, high: Array, weight: float):
        """low, high (3,) [m] world; weight [1/m]."""
        self._low, self._high, self._weight = torch.as_tensor(low), torch.as_tensor(high), weight

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        p = rollouts.grip.position.to(rollouts.position.device)
        if not p.shape[-2]:
            return rollouts.position.new_zeros(p.shape[1])
        out = torch.maximum(self._low.to(p) - p, p - self._high.to(p)).clamp_min(0.0)
        return self._weight * out.norm(dim=-1).amax(-1).mean(0)

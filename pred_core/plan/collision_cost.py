"""Collision with fixtures and the table: of the object, and of the gripper's fingers."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pred_core.plan.distance import depth_in
from pred_core.plan.rollouts import Rollouts
from pred_core.types import Body, Fixture, Scene

SPHERES = 4  # along the fingers' capsule


class CollisionCost:
    """`weight` x (deepest point of the object + deepest point of the fingers) [m], each a mean over time.

    The object is judged at the looked-at steps, lines between their particles too; the fingers at every step. They
    are an upright capsule above the tool centre, because a plan turns only about z. The object may lie on the table,
    the tool centre may not go below it. Without fixtures and table the cost is 0.
    """

    name = "collision"

    def __init__(self, scene: Scene, body: Body, weight: float, margin: float, radius: float, length: float):
        """margin [m] kept by the object; radius, length [m] of the fingers; weight [1/m]."""
        self._fixtures: tuple[Fixture, ...] = scene.fixtures
        self._ground = scene.ground
        self._weight, self._keep, self._radius = weight, margin + body.radius, radius
        self._line = torch.as_tensor(np.argsort(body.arc, kind="stable")) if body.kind == "line" else None
        self._spheres = torch.zeros(SPHERES, 3)
        self._spheres[:, 2] = torch.linspace(0.0, length, SPHERES)

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        return self._weight * (self.object_depth(rollouts) + self.finger_depth(rollouts))

    def object_depth(self, rollouts: Rollouts) -> Tensor:
        """(K,) [m] deepest point of the object, mean over the looked-at steps."""
        position = rollouts.position[list(rollouts.frames)]
        if self._line is not None:
            line = position.index_select(-2, self._line.to(position.device))
            position = torch.cat((line, 0.5 * (line[..., 1:, :] + line[..., :-1, :])), dim=-2)
        return depth_in(self._fixtures, position, self._keep).amax(-1).mean(0)

    def finger_depth(self, rollouts: Rollouts) -> Tensor:
        """(K,) [m] deepest point of any gripper's fingers, mean over all steps."""
        device = rollouts.position.device
        origin = rollouts.grip.position.to(device)
        if not origin.shape[-2]:
            return rollouts.position.new_zeros(rollouts.position.shape[1])
        depth = depth_in(self._fixtures, origin.unsqueeze(-2) + self._spheres.to(device), self._radius).amax(-1)
        if self._ground is not None:
            depth = torch.maximum(depth, self._ground - origin[..., 2])
        return depth.amax(-1).mean(0)

"""Collision with fixtures and the table: of the object, and of the gripper's hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.plan.distance import depth_in
from pred_core.plan.rollouts import Rollouts
from pred_core.types import Body, Fixture, Scene

STEP = 0.025  # [m] at most between the spheres that stand for a capsule


@dataclass(frozen=True)
class Hand:
    """A gripper as two upright capsules: fingers from the tool centre up, the palm above them."""

    finger_radius: float  # [m]
    finger_length: float  # [m] from the tool centre to the palm
    palm_radius: float  # [m], 0 = none
    palm_length: float  # [m] with its round ends

    def spheres(self) -> tuple[Tensor, Tensor]:
        """Heights above the tool centre (S,) [m] and radii (S,) [m]."""
        parts = [(0.0, self.finger_length, self.finger_radius)]
        if self.palm_radius > 0.0:
            low = self.finger_length + self.palm_radius
            parts.append((low, max(low, self.finger_length + self.palm_length - self.palm_radius), self.palm_radius))
        heights, radii = [], []
        for low, high, radius in parts:
            count = 1 + int(np.ceil((high - low) / STEP))
            heights.append(torch.linspace(low, high, count) if count > 1 else torch.tensor([low]))
            radii.append(torch.full((count,), radius))
        return torch.cat(heights), torch.cat(radii)


class CollisionCost:
    """`weight` x (deepest point of the object + deepest point of a hand) [m], means over time, + `hit` x share of time.

    A grazing hand is as much a collision as a deep one: `hit` weighs the share of the steps in which one is inside.

    The object is judged at the looked-at steps, lines between their particles too; hands at every step. Hands stand
    upright because a plan turns only about z. The object may lie on the table, the tool centre may not go below it.
    Without fixtures and table the cost is 0.
    """

    name = "collision"

    def __init__(
        self, scene: Scene, body: Body, hand: Hand, weight: float, margin: float, *, hit: float = 0.0,
        hand_margin: float = 0.0,
    ):  # fmt: skip
        """margin, hand_margin [m] kept by the object, by hands; weight [1/m]."""
        self._fixtures: tuple[Fixture, ...] = scene.fixtures
        self._ground = scene.ground
        self._weight, self._keep = weight, margin + body.radius
        self._line = torch.as_tensor(np.argsort(body.arc, kind="stable")) if body.kind == "line" else None
        heights, self._radii = hand.spheres()
        self._radii = self._radii + hand_margin
        self._hit = hit
        self._spheres = torch.zeros(len(heights), 3)
        self._spheres[:, 2] = heights

    def __call__(self, rollouts: Rollouts) -> Tensor:
        """(K,)."""
        inside = self.hand_inside(rollouts)
        depth = self.object_depth(rollouts) + inside.mean(0)
        return self._weight * depth + self._hit * (inside > 0.0).to(depth).mean(0)

    def object_depth(self, rollouts: Rollouts) -> Tensor:
        """(K,) [m] deepest point of the object, mean over the looked-at steps."""
        position = rollouts.position[list(rollouts.frames)]
        if self._line is not None:
            line = position.index_select(-2, self._line.to(position.device))
            position = torch.cat((line, 0.5 * (line[..., 1:, :] + line[..., :-1, :])), dim=-2)
        return depth_in(self._fixtures, position, self._keep).amax(-1).mean(0)

    def hand_inside(self, rollouts: Rollouts) -> Tensor:
        """(T, K) [m] deepest point of any hand at every step."""
        device = rollouts.position.device
        origin = rollouts.grip.position.to(device)
        if not origin.shape[-2]:
            return rollouts.position.new_zeros(rollouts.position.shape[:2])
        centers = origin.unsqueeze(-2) + self._spheres.to(device)
        depth = depth_in(self._fixtures, centers, self._radii.to(device)).amax(-1)
        if self._ground is not None:
            depth = torch.maximum(depth, self._ground - origin[..., 2])
        return depth.amax(-1)

"""Candidates with different connection thresholds in one batch: springs of a union, masked per world."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pred_core.springmass.topology import loose_particles, union_topology
from pred_core.types import Array, Body, Physics


class Topology:
    """All springs any candidate may have within `widest` [m] and `most` springs a particle."""

    def __init__(self, body: Body, widest: float, most: int):
        springs, self.member = union_topology(body.rest_position, widest, most)
        self.most = most
        length = np.linalg.norm(body.rest_position[springs[:, 1]] - body.rest_position[springs[:, 0]], axis=1)
        self.distance: Array = length
        known = {tuple(p): n for p, n in zip(body.springs.tolist(), body.rest_length.tolist(), strict=True)}
        rest = np.array([known.get(tuple(p), d) for p, d in zip(springs.tolist(), length, strict=True)])
        self.union = dataclasses.replace(
            body,
            springs=springs,
            rest_length=rest,
            stiffness_scale=np.ones(len(springs)),
            damping_scale=np.ones(len(springs)),
        )

    def chosen(self, physics: Physics) -> np.ndarray:
        """(S,) bool: the springs these parameters make."""
        column = min(physics.max_springs, self.most) - 1
        return (self.member[:, column] > 0) & (self.distance <= physics.connection_threshold)

    def loose(self, physics: Physics) -> list[int]:
        """Particles these parameters leave unconnected."""
        return loose_particles(self.union.count, self.union.springs[self.chosen(physics)])

    def body(self, physics: Physics) -> Body:
        """The body with only the chosen springs."""
        keep = self.chosen(physics)
        u = self.union
        return dataclasses.replace(
            u,
            springs=np.ascontiguousarray(u.springs[keep]),
            rest_length=u.rest_length[keep],
            stiffness_scale=u.stiffness_scale[keep],
            damping_scale=u.damping_scale[keep],
        )

    def masks(self, candidates: Sequence[Physics], windows: int) -> Tensor:
        """(C * windows, S) float: 1 where a world has the spring."""
        rows = np.stack([self.chosen(p) for p in candidates]).astype(np.float32)
        return torch.as_tensor(rows).repeat_interleave(windows, dim=0)

"""Candidates with different connection thresholds in one batch: springs of a union, masked per world."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.springmass.topology import loose_particles, union_topology
from pred_core.types import Array, Body, Physics

Chosen = NDArray[np.bool_]


class Topology:
    """All springs any candidate may have within `widest` [m] and `most` springs a particle."""

    def __init__(self, body: Body, widest: float, most: int):
        springs, member = union_topology(body.rest_position, widest, most)
        self.member: Chosen = member > 0  # (S, most): the spring exists with so many springs a particle
        self.most = most
        length = np.linalg.norm(body.rest_position[springs[:, 1]] - body.rest_position[springs[:, 0]], axis=1)
        self.distance: Array = np.asarray(length, dtype=np.float64)
        known = {tuple(p): n for p, n in zip(body.springs.tolist(), body.rest_length.tolist(), strict=True)}
        rest = np.array([known.get(tuple(p), d) for p, d in zip(springs.tolist(), length, strict=True)])
        self.union = dataclasses.replace(
            body,
            springs=springs,
            rest_length=rest,
            stiffness_scale=np.ones(len(springs)),
            damping_scale=np.ones(len(springs)),
        )
        self._loose: dict[bytes, int] = {}

    def chosen(self, physics: Physics) -> Chosen:
        """(S,) the springs these parameters make."""
        column = min(physics.max_springs, self.most) - 1
        return np.logical_and(self.member[:, column], self.distance <= physics.connection_threshold)

    def loose(self, physics: Physics) -> int:
        """How many particles these parameters leave unconnected."""
        chosen = self.chosen(physics)
        key = np.packbits(chosen).tobytes()
        if key not in self._loose:
            self._loose[key] = len(loose_particles(self.union.count, self.union.springs[chosen]))
        return self._loose[key]

    def body(self, physics: Physics) -> Body:
        """The body with only the chosen springs."""
        return self._with(self.chosen(physics))

    def shared(self, physics: Sequence[Physics], windows: int) -> tuple[Body, Tensor | None]:
        """(body with the springs any of C candidates has, mask (C * windows, S) 1 where a world has the spring)."""
        rows = np.stack([self.chosen(p) for p in physics])
        used: Chosen = np.logical_or.reduce(rows, axis=0)
        rows = rows[:, used]
        if rows.all():
            return self._with(used), None
        mask = torch.as_tensor(rows.astype(np.float32)).repeat_interleave(windows, dim=0)
        return self._with(used), mask

    def _with(self, keep: Chosen) -> Body:
        u = self.union
        return dataclasses.replace(
            u,
            springs=np.ascontiguousarray(u.springs[keep]),
            rest_length=u.rest_length[keep],
            stiffness_scale=u.stiffness_scale[keep],
            damping_scale=u.damping_scale[keep],
        )

"""Neighbours keep their distances and turn together: what is not measured follows what is (Sorkine & Alexa 2007)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import factorized
from scipy.spatial import cKDTree

from pred_core.types import Array


class RigidityGraph:
    """Edges between each particle and its nearest neighbours in the first position."""

    def __init__(self, rest: Array, neighbours: int = 8):
        self.rest = rest
        count = min(neighbours + 1, len(rest))
        _, near = cKDTree(rest).query(rest, k=count)
        self.neighbours: NDArray[np.int64] = near[:, 1:]  # (P, k)
        self.offset = rest[self.neighbours] - rest[:, None]  # (P, k, 3) [m]
        i = np.repeat(np.arange(len(rest)), count - 1)
        j = self.neighbours.ravel()
        one = csr_matrix((np.ones(len(i)), (i, j)), shape=(len(rest),) * 2)
        both = one + one.T
        self._edges = both
        self._laplacian = (diags(np.asarray(both.sum(axis=1)).ravel()) - both).tocsc()

    def rotations(self, position: Array) -> Array:
        """(P, 3, 3): how each neighbourhood has turned since the first position."""
        moved = position[self.neighbours] - position[:, None]
        u, _, v = np.linalg.svd(np.einsum("pka,pkb->pab", moved, self.offset))
        flip = np.linalg.det(u @ v)
        u[:, :, 2] *= flip[:, None]
        return np.asarray(u @ v)

    def solve(self, start: Array, target: Array, weight: Array, stiffness: float, rounds: int = 2) -> Array:
        """Positions (P, 3) near `target` (P, 3) by `weight` (P,) that bend rather than stretch."""
        position = start
        solve = factorized((diags(weight) + stiffness * self._laplacian).tocsc())
        i = np.repeat(np.arange(len(start)), self.neighbours.shape[1])
        j = self.neighbours.ravel()
        for _ in range(rounds):
            turn = self.rotations(position)
            pair = 0.5 * (turn[i] + turn[j])
            pull = -stiffness * np.einsum("eab,eb->ea", pair, self.offset.reshape(-1, 3))
            right = weight[:, None] * target
            np.add.at(right, i, pull)
            np.add.at(right, j, -pull)
            position = np.stack([solve(right[:, k]) for k in range(3)], axis=-1)
        return position

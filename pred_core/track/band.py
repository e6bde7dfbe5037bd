"""Least squares over a chain of nodes: a block-banded normal matrix."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from pred_core.types import Array


class ChainSystem:
    """Sum of weighted squares of nodes (N, 3), node j coupled with j+1 and j+2: H x = g."""

    def __init__(self, count: int):
        self.diagonal = np.zeros((count, 3, 3))
        self.next = np.zeros((count, 3, 3))  # block (j + 1, j); the last one is unused
        self.second = np.zeros(count)  # block (j + 2, j) = value * identity
        self.right = np.zeros((count, 3))

    def add_bending(self, weight: float) -> None:
        """weight |x_{j-1} - 2 x_j + x_{j+1}|^2 for every inner node."""
        n, eye = len(self.diagonal), np.eye(3)
        if n < 3:
            return
        first, middle, last = (np.zeros(n) for _ in range(3))
        first[:-2], middle[1:-1], last[2:] = 1.0, 4.0, 1.0
        self.diagonal += weight * (first + middle + last)[:, None, None] * eye
        coupling = np.zeros(n)
        coupling[:-2] -= 2.0
        coupling[1:-1] -= 2.0
        self.next += weight * coupling[:, None, None] * eye
        self.second[:-2] += weight

    def add_spacing(self, nodes: Array, spacing: float, weight: float) -> None:
        """weight (|x_{j+1} - x_j| - spacing)^2, linear about `nodes` (N, 3) [m]."""
        edge = np.diff(nodes, axis=0)
        along = edge / np.linalg.norm(edge, axis=-1, keepdims=True)
        outer = weight * along[:, :, None] * along[:, None, :]
        pull = weight * spacing * along
        self.diagonal[:-1] += outer
        self.diagonal[1:] += outer
        self.next[:-1] -= outer
        self.right[1:] += pull
        self.right[:-1] -= pull

    def add_points(self, information: Array, target: Array) -> None:
        """(x_j - target_j)^T information_j (x_j - target_j), (N, 3, 3) and (N, 3)."""
        self.diagonal += information
        self.right += np.einsum("nab,nb->na", information, target)

    def solve(self) -> Array:
        """The nodes (N, 3) of least cost."""
        return np.asarray(solveh_banded(self._band(), self.right.ravel(), lower=True)).reshape(-1, 3)

    def covariance(self) -> Array:
        """Diagonal blocks (N, 3, 3) of the inverse normal matrix."""
        n = len(self.diagonal)
        inverse = np.asarray(solveh_banded(self._band(), np.eye(3 * n), lower=True)).reshape(n, 3, n, 3)
        at = np.arange(n)
        return np.ascontiguousarray(inverse[at, :, at, :])

    def _band(self) -> Array:
        n = len(self.diagonal)
        band = np.zeros((9, 3 * n))
        for a in range(3):
            for b in range(3):
                if a >= b:
                    band[a - b, b::3] = self.diagonal[:, a, b]
                band[3 + a - b, b : 3 * (n - 1) : 3] += self.next[:-1, a, b]
        if n > 2:
            band[6, : 3 * (n - 2)] = np.repeat(self.second[:-2], 3)
        return band

"""A correction moves the body; it must not stretch it.

Springs are stiff: a stretch of a tenth of a millimetre is more energy than the motion has. So after a correction every
spring gets back the length it had, and its ends no velocity along it: the smallest further change, in the sense of the
particles' masses, that does so (projection onto the constraints, as in Goldenthal et al. 2007).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import cg

from pred_core.types import Array, Body

STEPS = 3  # Newton steps to the lengths
RIDGE = 1e-6  # of the diagonal: nets of springs have more lengths than particles can move
DENSE = 150  # springs that are solved for at once
SWEEPS = 40  # of conjugate gradients, for more


class Lengths:
    """Of one body; `free` (N,) 1 where a particle may move, 0 where it is held."""

    def __init__(self, body: Body, free: Array):
        i, j = body.springs[:, 0].astype(np.int64), body.springs[:, 1].astype(np.int64)
        moving = free[i] + free[j] > 0
        self._i, self._j = i[moving], j[moving]
        self._weight = np.repeat(free * body.mass.mean() / body.mass, 3)  # (3 N,) mobilities
        rows = np.repeat(np.arange(len(self._i)), 6)
        ends = np.stack([3 * e[:, None] + np.arange(3) for e in (self._i, self._j)], axis=1)
        self._places = rows, ends.reshape(-1)
        self._shape = len(self._i), 3 * body.count

    def keep(self, before: Array, after: Array) -> Array:
        """`after` (N, 3) [m], moved so that its springs are as long as in `before`."""
        length = np.linalg.norm(before[self._j] - before[self._i], axis=1)
        x = after.copy()
        for _ in range(STEPS):
            apart = x[self._j] - x[self._i]
            now = np.linalg.norm(apart, axis=1)
            x -= self._change(apart / np.maximum(now, 1e-9)[:, None], now - length)
        return x

    def still(self, position: Array, change: Array) -> Array:
        """`change` (N, 3) [m/s] of velocity without what it does along the springs at `position` (N, 3) [m]."""
        apart = position[self._j] - position[self._i]
        along = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-9)[:, None]
        return change - self._change(along, ((change[self._j] - change[self._i]) * along).sum(axis=1))

    def _change(self, along: Array, growth: Array) -> Array:
        """(N, 3) the smallest change that makes springs along `along` (S, 3) longer by `growth` (S,)."""
        if not len(growth):
            return np.zeros((self._shape[1] // 3, 3))
        values = np.stack((-along, along), axis=1).reshape(-1)
        if len(growth) <= DENSE:
            jacobian = np.zeros(self._shape)
            jacobian[self._places] = values
            weighted = jacobian * self._weight
            normal = weighted @ jacobian.T
            normal[np.diag_indices_from(normal)] += RIDGE * normal.diagonal().max()
            return np.asarray(np.linalg.solve(normal, growth) @ weighted).reshape(-1, 3)
        sparse = csr_array((values, self._places), shape=self._shape)
        weighted = sparse * self._weight
        normal = weighted @ sparse.T
        tension, _ = cg(normal + RIDGE * normal.diagonal().max() * eye_array(len(growth)), growth, maxiter=SWEEPS)
        return np.asarray(weighted.T @ tension).reshape(-1, 3)

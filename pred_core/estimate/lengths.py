"""A correction moves the body; it must not stretch it.

Springs are stiff: a stretch of a tenth of a millimetre is more energy than the motion has. So after a correction every
spring gets back the length it had, and its ends no velocity along it: the smallest further change, in the sense of the
particles' masses, that does so (projection onto the constraints, as in Goldenthal et al. 2007).

Nets of springs have more lengths than particles can move, and too many to solve for in a period: there LSQR (Paige and
Saunders 1982) stops early. What it leaves of the stretch falls with every sweep, so less is done, never harm; conjugate
gradients on the normal equations do not have that property, and left a net torn where they stopped.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsqr

from pred_core.types import Array, Body

STEPS = 3  # Newton steps to the lengths
RIDGE = 1e-6  # of the diagonal: nets of springs have more lengths than particles can move
DENSE = 150  # springs that are solved for at once
SWEEPS = 20  # of LSQR, for more
NEAR = 1e-3  # share of the stretch at which it stops before


class Lengths:
    """Of one body; `free` (N,) 1 where a particle may move, 0 where it is held."""

    def __init__(self, body: Body, free: Array):
        i, j = body.springs[:, 0].astype(np.int64), body.springs[:, 1].astype(np.int64)
        moving = free[i] + free[j] > 0
        if body.kind == "line":  # springs that reach farther stand for bending: they change when it bends
            place = np.argsort(np.argsort(body.arc, kind="stable"))
            moving &= np.abs(place[i] - place[j]) == 1
        self._i, self._j = i[moving], j[moving]
        self._weight = np.repeat(free * body.mass.mean() / body.mass, 3)  # (3 N,) mobilities
        self._root = np.sqrt(self._weight)
        rows = np.repeat(np.arange(len(self._i)), 6)
        ends = np.stack([3 * e[:, None] + np.arange(3) for e in (self._i, self._j)], axis=1)
        self._places = rows, ends.reshape(-1)
        self._shape = len(self._i), 3 * body.count

    def keep(self, before: Array, after: Array) -> Array:
        """`after` (N, 3) [m], moved so that its springs are as long as in `before`, or nearer to it than they were."""
        length = np.linalg.norm(before[self._j] - before[self._i], axis=1)
        x = best = after.copy()
        along, growth = self._stretch(x, length)
        least = float(np.linalg.norm(growth))
        for _ in range(STEPS):
            x = x - self._change(along, growth)
            along, growth = self._stretch(x, length)
            left = float(np.linalg.norm(growth))
            if left <= least:
                best, least = x, left
        return best

    def _stretch(self, x: Array, length: Array) -> tuple[Array, Array]:
        """Directions (S, 3) of the springs at `x` (N, 3), and what they are longer (S,) [m] than `length` (S,)."""
        apart = x[self._j] - x[self._i]
        now = np.linalg.norm(apart, axis=1)
        return apart / np.maximum(now, 1e-9)[:, None], now - length

    def still(self, position: Array, change: Array) -> Array:
        """`change` (N, 3) [m/s] of velocity without what it does along the springs at `position` (N, 3) [m]."""
        apart = position[self._j] - position[self._i]
        along = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-9)[:, None]
        return change - self._change(along, ((change[self._j] - change[self._i]) * along).sum(axis=1))

    def _change(self, along: Array, growth: Array) -> Array:
        """(N, 3) the smallest change that makes springs along `along` (S, 3) longer by `growth` (S,); of more than
        DENSE springs, one that leaves no more of it than there was.
        """
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
        # In coordinates scaled by the roots of the mobilities the smallest change is the one of least length.
        scaled = csr_array((values, self._places), shape=self._shape) * self._root
        damp = float(np.sqrt(RIDGE * scaled.multiply(scaled).sum(axis=1).max()))
        change = lsqr(scaled, growth, damp=damp, atol=NEAR, btol=NEAR, iter_lim=SWEEPS)[0]
        return np.asarray(self._root * change).reshape(-1, 3)

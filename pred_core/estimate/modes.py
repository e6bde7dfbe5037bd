"""Smooth shapes along a body, and how much of each an error of the model has.

An error that is alike over a distance l along the body is a Gaussian field with the covariance of Whittle and Matern,
(1/l^2 + L)^-2, L the Laplacian of the graph of the springs (Lindgren, Rue and Lindstroem 2011, section 2.3). Held
particles are where their gripper is: the field is zero there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import eigsh

from pred_core.types import Array, Body

DIMENSIONS = {"line": 1, "sheet": 2, "volume": 3, "mixed": 2}
ROUGH = 1e-4  # share of an error's variance that no correlation explains
SMOOTHER = 4.0  # times the distance over which errors are alike: shapes, and what tracks have in common with neighbours
DENSE = 1500  # particles up to which all eigenvectors are found at once


@dataclass(frozen=True)
class Modes:
    """Orthonormal shapes and the variance of their amplitudes; a particle's variance is 1 on average."""

    shape: Array  # (N, M), zero at held particles
    variance: Array  # (M,)


def error_modes(body: Body, held: NDArray[np.bool_], correlation: float, most: int) -> Modes:
    """The smoothest shapes of `body`, zero where `held` (N,); `correlation` [m] is the distance of likeness."""
    free = np.flatnonzero(~held)
    if not len(free):
        return Modes(np.zeros((body.count, 0)), np.zeros(0))
    values, vectors = _smoothest(_laplacian(body)[free][:, free], min(most, len(free)))
    spectrum = (1.0 / correlation**2 + np.maximum(values, 0.0)) ** -2.0
    spectrum = spectrum / spectrum.sum() + ROUGH / len(spectrum)
    shape = np.zeros((body.count, len(values)))
    shape[free] = vectors
    return Modes(shape, spectrum * len(free) / spectrum.sum())


def _laplacian(body: Body) -> csr_array:
    """(N, N) [1/m^2]: minus the second derivative along the body.

    A spring of length l adds (f_i - f_j) g / l^2; g makes the second moments of a particle's springs sum to 2 for
    each dimension, as for neighbours on a grid.
    """
    i, j = body.springs[:, 0], body.springs[:, 1]
    degree = max(2.0 * len(i) / body.count, 1.0)
    weight = 2.0 * DIMENSIONS[body.kind] / degree / np.maximum(body.rest_length, 1e-9) ** 2
    off = csr_array((np.concatenate((weight, weight)), (np.concatenate((i, j)), np.concatenate((j, i)))),
                    shape=(body.count, body.count))  # fmt: skip
    return csr_array(diags_array(np.asarray(off.sum(axis=1)).ravel()) - off)


def _smoothest(laplacian: csr_array, count: int) -> tuple[Array, Array]:
    """The lowest eigenvalues (M,) and their vectors (N, M)."""
    if laplacian.shape[0] <= DENSE or 2 * count > laplacian.shape[0]:
        values, vectors = np.linalg.eigh(laplacian.toarray())
    else:
        below = -1e-3 * float(laplacian.diagonal().mean())  # factorising at 0 would fail: L is singular
        start = np.ones(laplacian.shape[0])  # else a random one
        values, vectors = eigsh(laplacian.tocsc(), k=count, sigma=below, v0=start)
    return values[:count], vectors[:, :count]

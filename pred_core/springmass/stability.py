"""How many substeps a period needs: semi-implicit Euler is stable while h^2 w^2/4 + h d/2 < 1.

w^2 and d are the largest eigenvalues of stiffness/mass and damping/mass; both are bounded per particle by
Gershgorin's theorem (a spring's 2x2 block adds 2k/m at most), so the choice is safe and never a guess.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import ConfigError
from pred_core.types import Array, Body, Physics

SAFETY = 0.5  # of the stability limit: keeps the error of fast modes small too
MOST_SUBSTEPS = 20_000


def spectrum_bound(
    body: Body,
    physics: Physics,
    bend: tuple[float, float] = (0.0, 0.0),
    held: NDArray[np.bool_] | None = None,
    mass: Array | None = None,
) -> tuple[float, float]:
    """(w [rad/s], d [1/s]): bounds of the highest frequency and the highest damping rate.

    `bend`: relative bending stiffness and bending damping time [s] that effects add. `held` (N,): particles that
    never move freely; they have no frequency of their own. `mass` (N,) [kg] replaces the body's.
    """
    mass = body.mass if mass is None else mass
    free = np.ones(body.count) if held is None else 1.0 - held
    k = physics.stiffness * body.stiffness_scale / np.maximum(body.rest_length, 1e-9)
    c = physics.damping * body.damping_scale
    w2, d = np.zeros(body.count), np.zeros(body.count)
    for end in (0, 1):
        i, j = body.springs[:, end], body.springs[:, 1 - end]
        # Row sum of the mass-scaled matrix: k/m_i + k/sqrt(m_i m_j).
        weight = free[i] * (1.0 / mass[i] + free[j] / np.sqrt(mass[i] * mass[j]))
        np.add.at(w2, i, k * weight)
        np.add.at(d, i, c * weight)
    if physics.bending_stiffness > 0 and len(body.bends):
        before, at, after = body.bends.T
        a = np.linalg.norm(body.rest_position[at] - body.rest_position[before], axis=1)
        b = np.linalg.norm(body.rest_position[after] - body.rest_position[at], axis=1)
        lbar = 0.5 * (a + b)
        stiff = physics.bending_stiffness * body.bend_scale / lbar
        # Hessian of a straight bend: EI/lbar g g^T with g = (1/a, -(1/a + 1/b), 1/b) per transverse axis.
        g = np.stack((1 / a, 1 / a + 1 / b, 1 / b), axis=1) * free[body.bends]
        root_mass = np.sqrt(mass[body.bends])
        row = (g / root_mass) * (g / root_mass).sum(1, keepdims=True) * stiff[:, None]
        np.add.at(w2, body.bends, row * (1.0 + bend[0]))
        np.add.at(d, body.bends, row * bend[1])
    return math.sqrt(float(w2.max(initial=0.0))), float(d.max(initial=0.0))


def choose_substeps(
    body: Body,
    period: float,
    physics: list[Physics],
    bends: list[tuple[float, float]] | None = None,
    held: NDArray[np.bool_] | None = None,
    masses: list[Array] | None = None,
) -> int:
    """The fewest substeps that keep every world at `SAFETY` of the stability limit. See `spectrum_bound`.

    Raises: ConfigError if more than 20,000 a period would be needed.
    """
    worst = 1
    for n, p in enumerate(physics):
        w, d = spectrum_bound(body, p, bends[n] if bends else (0.0, 0.0), held, masses[n] if masses else None)
        # Largest h with h^2 w^2/4 + h d/2 = 1.
        limit = period if w == d == 0 else 4.0 / (d + math.sqrt(d * d + 4.0 * w * w))
        worst = max(worst, math.ceil(period / (SAFETY * limit)))
    if worst > MOST_SUBSTEPS:
        raise ConfigError(
            "the springs are too stiff for their mass", got=f"{worst} substeps a period",
            allowed=f"at most {MOST_SUBSTEPS}", next_step="Lower stiffness or damping, or use fewer, heavier particles",
        )
    return worst

"""How many substeps a period needs: semi-implicit Euler is stable while h^2 w^2/4 + h d/2 < 1.

w^2 and d are the largest eigenvalues of stiffness/mass and damping/mass; both are bounded per particle by
Gershgorin's theorem (a spring's 2x2 block adds 2k/m at most).

Bends stiffen with their angle: of E = (2 EI/lbar) t^2, t = tan(angle/2), the second derivative by the angle is
(1 + t^2)(1 + 3 t^2) EI/lbar, and damping of kb = 2t is (1 + t^2)^2 tau EI/lbar. The choice is safe up to
`SHARPEST`, 90 degrees between edges; a line folded sharper than that needs more. Bends so sharp also press
edges together, by the slope of E over the edge, (2 EI/lbar) t (1 + t^2) / edge [N], against the spring's stiffness;
shorter edges make stiffer bends (1/edge^2). This counts where bends rival the springs, up to `MOST_PRESSED`; tests show
it safe where springs yield by a quarter to their own bends. Undamped springs that yield by half or more may blow up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import ConfigError
from pred_core.springmass.topology import bend_edges
from pred_core.types import Array, Body, Physics

SAFETY = 0.5  # of the stability limit: keeps the error of fast modes small too
LEAST_SUBSTEPS = 2  # for contact and falling, where nothing oscillates
MOST_SUBSTEPS = 20_000
SHARPEST = math.pi / 2  # [rad] between the edges of a bend
# Growth of a bend from straight to `SHARPEST`: 8 in stiffness and 4 in damping. `SAFETY` leaves room for 1/SAFETY^2 = 4
# and 1/SAFETY = 2 of it; what remains is the same for both.
_T2 = math.tan(0.5 * SHARPEST) ** 2
SHARP = max((1.0 + _T2) * (1.0 + 3.0 * _T2) * SAFETY**2, (1.0 + _T2) ** 2 * SAFETY)
_PRESS = 2.0 * math.sqrt(_T2) * (1.0 + _T2)  # times EI/(lbar edge)
MOST_PRESSED = 0.5  # of an edge; springs that yield more to their own bends do not hold an object together


@dataclass(frozen=True)
class Added:
    """What effects add at most, see `parameters.added_by`."""

    scale: Array | float = 1.0  # (B,) of each bend's stiffness, also of what `stiffness` and `time` add to it
    stiffness: float = 0.0  # of bends, relative
    time: float = 0.0  # [s] bending damping over bending stiffness
    rate: float = 0.0  # [1/s] at which a free particle loses speed


def spectrum_bound(
    body: Body,
    physics: Physics,
    added: Added = Added(),  # noqa: B008 (frozen)
    held: NDArray[np.bool_] | None = None,
    mass: Array | None = None,
) -> tuple[float, float]:
    """(w [rad/s], d [1/s]): the highest frequency and damping rate, of bends as far as `SAFETY` does not cover them.

    `held` (N,): particles that never move freely; they have no frequency of their own. `mass` (N,) [kg] replaces the
    body's.
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
        a, b = bend_edges(body).T
        weight = physics.bending_stiffness * body.bend_scale * added.scale / (0.5 * (a + b))
        stiff = SHARP * weight
        shorter = 1.0 - np.minimum(_PRESS * weight / np.minimum(a, b) / max(physics.stiffness, 1e-9), MOST_PRESSED)
        a, b = a * shorter, b * shorter
        # Hessian at the angle: EI/lbar g g^T with |g| = (1/a, |n_a/a + n_b/b|, 1/b) across the edges' directions.
        middle = np.sqrt(1 / a**2 + 1 / b**2 + 2 * math.cos(SHARPEST) / (a * b))
        g = np.stack((1 / a, middle, 1 / b), axis=1) * free[body.bends]
        root_mass = np.sqrt(mass[body.bends])
        row = (g / root_mass) * (g / root_mass).sum(1, keepdims=True) * stiff[:, None]
        np.add.at(w2, body.bends, row * (1.0 + added.stiffness))
        np.add.at(d, body.bends, row * added.time)
    return math.sqrt(float(w2.max(initial=0.0))), float(d.max(initial=0.0)) + added.rate


def demand(
    body: Body,
    period: float,
    physics: Physics,
    added: Added = Added(),  # noqa: B008 (frozen)
    held: NDArray[np.bool_] | None = None,
    mass: Array | None = None,
) -> float:
    """Substeps a period that keep one world at `SAFETY` of the stability limit, neither rounded nor limited."""
    w, d = spectrum_bound(body, physics, added, held, mass)
    # The largest h with h^2 w^2/4 + h d/2 = 1 is 4 / (d + sqrt(d^2 + 4 w^2)).
    return period * (d + math.sqrt(d * d + 4.0 * w * w)) / (4.0 * SAFETY)


def choose_substeps(
    body: Body,
    period: float,
    physics: list[Physics],
    added: list[Added],
    held: NDArray[np.bool_] | None = None,
    masses: list[Array] | None = None,
) -> int:
    """The fewest substeps that keep every world at `SAFETY` of the stability limit. See `demand`.

    Raises: ConfigError if more than 20,000 a period would be needed.
    """
    worst = LEAST_SUBSTEPS
    for n, p in enumerate(physics):
        worst = max(worst, math.ceil(demand(body, period, p, added[n], held, masses[n] if masses else None)))
    if worst > MOST_SUBSTEPS:
        raise ConfigError(
            "the springs are too stiff for their mass", got=f"{worst} substeps a period",
            allowed=f"at most {MOST_SUBSTEPS}", next_step="Lower stiffness or damping, or use fewer, heavier particles",
        )
    return worst

"""Baseline: sparse regression on accelerations (SINDy, Brunton et al. 2016), as one would do without a simulator.

Positions, velocities and accelerations from a Savitzky-Golay filter over nine frames, smoothed along the line; the
laws of the library that are linear in their coefficients, written down as accelerations of a particle of a line; the
coefficients of the suspect set against those of the reference, pruned as long as one's change is not significant. The
tension of a rope that does not stretch shows in no measured strain: it is left free in every edge of every frame, by
projection. What remains is noise in the columns, which takes most of a coefficient: measured on a rope without any
effect, weight comes out as a third to a half of gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter
from scipy.stats import t as student

from pred_core.bag.clock import on_even_clock
from pred_core.types import Array, Episode

WINDOW, ORDER = 9, 3  # frames, polynomial
ALONG, ALONG_ORDER = 13, 5  # particles, polynomial
TOUCHES = 0.008  # [m] above the table
SLOW = 0.02  # [m/s] below which a sliding direction is not one
LEVEL = 0.05

# Columns that every line needs, which are the causes named beside them if they change.
BASE = {
    "bending": "bending_scale", "bending damping": "bending_damping",
    "weight": "", "support": "", "friction": "friction_scale",
}  # fmt: skip
EXTRA = {
    "drag": "drag_linear", "drag 2": "drag_quadratic", "push x": "gravity_offset", "push y": "gravity_offset",
    "blow x": "wind", "blow y": "wind", "viscous": "friction_viscous", "cos": "friction_anisotropic",
    "sin": "friction_anisotropic", "wear": "friction_drift", "age": "stiffness_drift", "slope": "bending_gradient",
    "inertia": "mass_gradient", "tip": "tip_mass",
}  # fmt: skip
CAUSES = (*BASE.values(), *EXTRA.values())


@dataclass(frozen=True)
class Normal:
    """Normal equations of one episode: what least squares needs of it."""

    matrix: Array  # (K, K)
    right: Array  # (K,)


def normal(episode: Episode, begin: int) -> Normal:
    """Of one episode of a line, of a session that began at `begin` [ns].

    Gaps of up to three frames are bridged by straight lines; frames with longer ones are left out.
    """
    even = on_even_clock(episode)
    period = even.period
    position = _bridged(even.position)
    x, v, a = (
        savgol_filter(position, WINDOW, ORDER, deriv=d, delta=period, axis=0, mode="constant")[WINDOW:-WINDOW]
        for d in (0, 1, 2)
    )
    minutes = (even.stamps[WINDOW:-WINDOW] - begin) / 60e9
    usable = np.isfinite(x).all(axis=(1, 2))
    x, v, a = (savgol_filter(q[usable], ALONG, ALONG_ORDER, axis=1) for q in (x, v, a))
    minutes = minutes[usable]
    rows = np.concatenate([_columns(x, v, a, minutes), a[None, :, 2:-2]])
    free = _without_tension(x, rows.reshape(*rows.shape[:2], -1))
    theta, y = free[:-1].reshape(len(rows) - 1, -1), free[-1].reshape(-1)
    return Normal(theta @ theta.T, theta @ y)


def _bridged(position: Array) -> Array:
    """Positions (T, P, 3) without gaps of up to three frames."""
    filled = position.copy()
    frames = np.arange(len(position))
    for p in range(position.shape[1]):
        known = frames[np.isfinite(position[:, p]).all(axis=1)]
        for before, after in zip(known[:-1], known[1:], strict=True):
            if 1 < after - before <= 4:
                share = (np.arange(before + 1, after) - before)[:, None] / (after - before)
                filled[before + 1 : after, p] = (1.0 - share) * position[before, p] + share * position[after, p]
    return filled


def _without_tension(x: Array, rows: Array) -> Array:
    """Rows (K, T, R) of each frame without what forces along the edges could do to it; x (T, P, 3)."""
    edge = np.diff(x, axis=1)
    along = edge / np.linalg.norm(edge, axis=-1, keepdims=True)
    frames, count = x.shape[0], x.shape[1] - 4
    pulls = np.zeros((frames, count, 3, count + 1))
    for n in range(count):  # the particle n + 2, between the edges n + 1 and n + 2
        pulls[:, n, :, n], pulls[:, n, :, n + 1] = -along[:, n + 1], along[:, n + 2]
    flat = pulls.reshape(frames, 3 * count, count + 1)
    back = np.linalg.pinv(flat, rcond=1e-9)  # a straight line's edges are not independent
    return rows - np.einsum("tre,tes,kts->ktr", flat, back, rows, optimize=True)


def _fourth(q: Array) -> Array:
    """Minus the fourth derivative along the line, by particle, what bending does: of a polynomial along the line.

    Differences of neighbours would be noise alone.
    """
    return -np.asarray(savgol_filter(q, ALONG, ALONG_ORDER, deriv=4, axis=1))[:, 2:-2]


def _columns(x: Array, v: Array, a: Array, minutes: Array) -> Array:
    """(K, T, P - 4, 3) of positions, velocities, accelerations (T, P, 3)."""
    count = x.shape[1]
    inner = slice(2, -2)
    arc = np.linspace(0.0, 1.0, count)[inner][None, :, None]
    w = v[:, inner]
    speed = np.linalg.norm(w, axis=-1, keepdims=True)
    flat = w * np.array([1.0, 1.0, 0.0])
    sliding = np.linalg.norm(flat, axis=-1, keepdims=True)
    touches = (x[:, inner, 2:] < TOUCHES).astype(float)
    rubs = -touches * flat / np.maximum(sliding, SLOW)
    turned = 2.0 * np.arctan2(w[..., 1:2], w[..., 0:1])
    ex, ey, ez = (np.broadcast_to(np.eye(3)[k], w.shape) for k in range(3))
    free = a[:, inner] + 9.81 * ez
    time = np.broadcast_to(minutes[:, None, None], (*w.shape[:2], 1))
    bend = _fourth(x)
    return np.stack([
        bend, _fourth(v), ez, touches * ez, rubs,
        -w, -speed * w, ex, ey, speed * ex, speed * ey, -touches * flat, rubs * np.cos(turned), rubs * np.sin(turned),
        rubs * time, bend * time, bend * (arc - 0.5), -(arc - 0.5) * free, (arc > 0.9) * -free,
    ])  # fmt: skip


def name(suspect: Sequence[Normal], reference: Sequence[Normal]) -> tuple[str, float]:
    """(the cause whose coefficients changed, share of its column's weight among the changes); ("none", 1.0) if none.

    Least squares of both sets together with a change for every named column; the least significant change (jackknife
    over episodes) is dropped until all that are left are significant, each of them for the number there was.
    """
    kept = [n for n, cause in enumerate(CAUSES) if cause]
    tests = len(kept)
    episodes = len(suspect) + len(reference)
    limit = float(student.ppf(1.0 - LEVEL / tests / 2.0, episodes - 1))
    size = np.sqrt(np.maximum(np.diag(_together(suspect)[0]), 1e-30))
    while kept:
        whole = _changes(suspect, reference, kept)
        left = [_changes([*suspect[:n], *suspect[n + 1 :]], reference, kept) for n in range(len(suspect))]
        left += [_changes(suspect, [*reference[:n], *reference[n + 1 :]], kept) for n in range(len(reference))]
        spread = np.array(left)
        error = np.sqrt((episodes - 1) / episodes * ((spread - spread.mean(axis=0)) ** 2).sum(axis=0))
        score = np.abs(whole) / np.maximum(error, 1e-30)
        if score.min() >= limit:
            weight = np.abs(whole) * size[kept]
            best = int(weight.argmax())
            return CAUSES[kept[best]], float(weight[best] / weight.sum())
        kept.pop(int(score.argmin()))
    return "none", 1.0


def _changes(suspect: Sequence[Normal], reference: Sequence[Normal], kept: Sequence[int]) -> Array:
    """(len(kept),) changes of coefficients, suspect minus reference."""
    gs, bs = _together(suspect)
    gr, br = _together(reference)
    g, b = gs + gr, bs + br
    matrix = np.block([[g, gs[:, kept]], [gs[kept], gs[np.ix_(kept, kept)]]])
    right = np.concatenate([b, bs[list(kept)]])
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    solved = np.linalg.lstsq(matrix * scale * scale[:, None], right * scale, rcond=1e-10)[0]
    return np.asarray((solved * scale)[len(b) :])


def _together(episodes: Sequence[Normal]) -> tuple[Array, Array]:
    return np.sum([n.matrix for n in episodes], axis=0), np.sum([n.right for n in episodes], axis=0)

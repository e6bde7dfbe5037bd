"""The table, from particles that rest on it while the gripper moves: a plane with its error over episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student

from pred_core.types import Array, Episode

WINDOW = 0.5  # [s] a particle rests if it stays in place that long
MOVED = 0.03  # [m] while its gripper moves that far
STILL = 4.0  # deviations of the noise, at least STILL_LEAST, within which it stays
STILL_LEAST = 1.5e-3  # [m]
TOGETHER = 3  # particles that rest at once: a hanging end that lags is alone
FLAT = 5e-4  # [m] spread of the heights of what rests on a plane, or the noise if that is larger; more is no plane
FEWEST = 3  # episodes
OFF = 0.02  # [m] from the plane, beyond which what is still does not rest on it: it hangs


@dataclass(frozen=True)
class Plane:
    """z = height + slope . (xy - middle) of resting particles' centres, with jackknife covariance over episodes."""

    middle: Array  # (2,) [m] world
    value: Array  # (3,) height [m], slope (2)
    covariance: Array  # (3, 3)
    episodes: int
    extent: Array  # (2,) [m] standard deviation of the resting points' x, y
    spread: float  # [m] of the resting points beside it: the median deviation as a normal standard deviation
    spreads: Array  # (<= episodes,) [m] the same of each episode by itself, of what is within OFF of it


def resting_points(episode: Episode, sigma: float) -> Array:
    """(M, 3) [m] world: mean places of free particles that rest while every gripper that holds moves."""
    frames = max(2, round(WINDOW / episode.period))
    held = episode.held >= 0
    grippers = np.unique(episode.held[held])
    if not len(grippers) or len(episode.stamps) < frames:
        return np.zeros((0, 3))
    place = episode.grips.position[:, grippers].double().numpy()
    still, points = max(STILL * sigma, STILL_LEAST), []
    for begin in range(0, len(episode.stamps) - frames + 1, frames):
        window = slice(begin, begin + frames)
        if np.ptp(place[window], axis=0).max(axis=-1).min() < MOVED:
            continue
        x = np.where(episode.tracks.visible[window, :, None], episode.position[window], np.nan)[:, ~held]
        whole = np.isfinite(x).all(axis=(0, 2))
        x = x[:, whole]
        rest = (np.abs(x - np.median(x, axis=0)).max(axis=(0, 2)) <= still) if x.size else np.zeros(0, bool)
        if rest.sum() >= TOGETHER:
            points.append(x[:, rest].mean(axis=0))
    return np.concatenate(points) if points else np.zeros((0, 3))


def fit_plane(episodes: Sequence[Episode], sigma: float, middle: Array | None = None) -> Plane | None:
    """The plane nearest to what rests; None if too little does."""
    points = [p for p in (resting_points(e, sigma) for e in episodes) if len(p)]
    if len(points) < FEWEST:
        return None
    everything = np.concatenate(points)
    where = everything[:, :2].mean(axis=0) if middle is None else middle
    value, residual = _plane(everything, where)
    pieces = np.split(residual, np.cumsum([len(p) for p in points])[:-1])
    parts = [_plane(np.concatenate(points[:k] + points[k + 1 :]), where)[0] for k in range(len(points))]
    off = np.array(parts) - np.mean(parts, axis=0)
    covariance = (len(points) - 1) / len(points) * off.T @ off + 1e-10 * np.diag([1.0, 1.0, 1.0])
    near = [r[np.abs(r) < OFF] for r in pieces]
    spreads = np.array([_spread(r) for r in near if len(r) >= TOGETHER])
    return Plane(where, value, covariance, len(points), everything[:, :2].std(axis=0), _spread(residual), spreads)


def _spread(residual: Array) -> float:
    return 1.4826 * float(np.median(np.abs(residual)))


def compare(value: Array, covariance: Array, part: slice, freedom: int) -> tuple[float, Array]:
    """p value that `value[part]` is zero, and its 90 % margins."""
    own, block = value[part], covariance[part, part]
    count = len(own)
    left = freedom - count + 1
    p = 1.0
    if left > 0:
        p = float(fisher.sf(float(own @ np.linalg.solve(block, own)) * left / (freedom * count), count, left))
    return p, student.ppf(0.95, freedom) * np.sqrt(np.diag(block))


def _plane(points: Array, middle: Array) -> tuple[Array, Array]:
    """(3,) height and slope by least squares with bisquare weights, and residuals (M,) [m]."""
    columns = np.concatenate((np.ones((len(points), 1)), points[:, :2] - middle), axis=1)
    z, weight = points[:, 2], np.ones(len(points))
    ridge = np.diag([0.0, 1e-4, 1e-4])  # a slope that nothing shows is zero
    value = np.array([float(np.median(z)), 0.0, 0.0])
    for _ in range(10):
        residual = z - columns @ value
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-5)
        weight = np.clip(1.0 - (residual / (4.7 * scale)) ** 2, 0.0, None) ** 2
        value = np.linalg.solve((columns * weight[:, None]).T @ columns + ridge, (columns * weight[:, None]).T @ z)
    return value, z - columns @ value

"""Reported held particles against where their gripper carries them: linearised, one episode at a time.

A held particle with lever l sits at x = p + A l; reported is y(t) = c + s R (x(t - d) - c) + b, plus, where the rope
slides in the jaws, a path along one of the gripper's axes. Every episode becomes the normal equations of its own
weighted least squares about a point, so that fits to any choice of episodes and unknowns are sums and small solves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pred_core.calibration import rotation_matrix
from pred_core.diagnose.gate_tracks import HeldTrack
from pred_core.types import Array

DELAY, SCALE, TURN, SHIFT = slice(0, 1), slice(1, 2), slice(2, 5), slice(5, 8)
GLOBAL = 8  # unknowns that all held particles share: delay [s], scale - 1, turn (3) [rad], shift (3) [m]
HUBER = 3.0  # robust: residuals beyond as many deviations count linearly
FINEST = 1e-5  # [m] noise assumed at least: what a tracker's float32 metres and a pose's rounding leave
KNOT = 0.5  # [s] between the knots of a slide
GLANCE = 5  # every fifth frame tells the noise
FREE_SLIDE = 0.3  # [m] prior deviation of a knot


@dataclass(frozen=True)
class Point:
    """Where the fit is linearised: the shared unknowns and a lever [m] for every particle id."""

    shared: Array  # (GLOBAL,)
    levers: Array  # (K, 3) [m] in the gripper's frame, rows as `ids`


@dataclass(frozen=True)
class Normal:
    """An episode's weighted normal equations in the shared unknowns, then the levers: (q, q), (q,), scalar."""

    matrix: Array
    gradient: Array
    misfit: float  # sum of weighted squares at the point
    count: int  # coordinates
    slide: Array = field(default_factory=lambda: np.zeros((0,)))  # (J,) knots [m] at the point
    slide_change: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (J, q) how they follow the unknowns

    def loss(self, step: Array) -> float:
        """Sum of weighted squares after `step` (q,) away from the point."""
        return float(self.misfit - 2.0 * self.gradient @ step + step @ self.matrix @ step)


def residuals(track: HeldTrack, lever: Array, shared: Array, center: Array) -> tuple[Array, Array, Array]:
    """Residual (F, 3) [m] (NaN where unknown), Jacobian (F, 3, GLOBAL + 3) of the model, and axes (F, 3, 3)."""
    place, axes, place_rate, axes_rate, known = track.pose_before(float(shared[0]), track.used)
    turn = (1.0 + float(shared[1])) * rotation_matrix(shared[TURN])
    true = place + axes @ lever
    away = true - center
    seen = away @ turn.T
    jacobian = np.empty((len(true), 3, GLOBAL + 3))
    jacobian[:, :, DELAY] = -((place_rate + axes_rate @ lever) @ turn.T)[:, :, None]
    jacobian[:, :, 1] = seen / (1.0 + shared[1])
    x, y, z = seen.T
    zero = np.zeros_like(x)
    jacobian[:, :, TURN] = np.stack(
        [np.stack(r, -1) for r in ((zero, z, -y), (-z, zero, x), (y, -x, zero))], axis=-2
    )  # turn x seen, column by column
    jacobian[:, :, SHIFT] = np.eye(3)
    jacobian[:, :, GLOBAL:] = turn @ axes
    residual = track.measured[track.used] - (center + seen + shared[SHIFT])
    residual[np.logical_not(known)] = np.nan
    return residual, jacobian, turn @ axes


def normal_equations(
    tracks: list[HeldTrack], ids: list[int], at: Point, center: Array, noise: float, slide_axis: int | None
) -> Normal:
    """One episode's equations about `at`. noise [m]; slide_axis: the gripper's axis it may slide along, or None."""
    q = GLOBAL + 3 * len(ids)
    matrix, gradient, misfit, count = np.zeros((q, q)), np.zeros(q), 0.0, 0
    knots = 0 if slide_axis is None else max(1, round(max(t.time[-1] for t in tracks) / KNOT))
    across, own, pull = np.zeros((knots, q)), np.eye(knots) / FREE_SLIDE**2, np.zeros(knots)
    for track in tracks:
        k = ids.index(track.id)
        residual, jacobian, axes = residuals(track, at.levers[k], at.shared, center)
        good = np.isfinite(residual).all(axis=1)
        r, j = residual[good], jacobian[good]
        size = np.linalg.norm(r, axis=1) / np.sqrt(3.0)
        w = np.full(len(r), 1.0 / noise**2)
        if slide_axis is None:
            w *= np.minimum(1.0, HUBER * noise / np.maximum(size, 1e-12))
        place = np.r_[0:GLOBAL, GLOBAL + 3 * k : GLOBAL + 3 * k + 3]  # what this particle depends on
        weighted = (j * w[:, None, None]).reshape(-1, GLOBAL + 3)
        matrix[np.ix_(place, place)] += weighted.T @ j.reshape(-1, GLOBAL + 3)
        gradient[place] += weighted.T @ r.ravel()
        misfit += float(w @ (r * r).sum(axis=1))
        count += r.size
        if knots:
            hats = slide_hats(track.time[track.used][good], knots)
            shape = axes[good][:, :, slide_axis]  # (T, 3)
            own += (hats * (w * (shape * shape).sum(axis=1))[:, None]).T @ hats
            across[:, place] += (hats * w[:, None]).T @ (shape[:, None, :] @ j)[:, 0]
            pull += hats.T @ (w * (shape * r).sum(axis=1))
    if not knots:
        return Normal(matrix, gradient, misfit, count)
    both = np.linalg.solve(own, np.concatenate((pull[:, None], across), axis=1)).astype(np.float64)
    solved, change = both[:, 0], both[:, 1:]
    return Normal(
        matrix - across.T @ change, gradient - across.T @ solved, misfit - float(pull @ solved), count, solved, -change
    )


def slide_hats(time: Array, knots: int) -> Array:
    """(T, knots) piecewise linear in time: 0 at the beginning, 1 at its own knot; constant after the last."""
    at = time[:, None] / KNOT - np.arange(1, knots + 1)
    hats = np.clip(1.0 - np.abs(at), 0.0, 1.0)
    hats[:, -1] = np.where(at[:, -1] > 0.0, 1.0, hats[:, -1])
    return hats


def typical_noise(episodes: list[list[HeldTrack]], ids: list[int], at: Point, center: Array) -> float:
    """Deviation of a coordinate [m] at the point, from the median (robust) of some frames, at least FINEST."""
    sizes = []
    turn = (1.0 + float(at.shared[1])) * rotation_matrix(at.shared[TURN])
    for tracks in episodes:
        for track in tracks:
            some = track.used[::GLANCE]
            place, axes, _, _, known = track.pose_before(float(at.shared[0]), some)
            away = place + axes @ at.levers[ids.index(track.id)] - center
            residual = track.measured[some] - (center + away @ turn.T + at.shared[SHIFT])
            sizes.append(np.abs(residual[known]).ravel())
    return max(1.4826 * float(np.median(np.concatenate(sizes))), FINEST) if sizes else FINEST

"""Suspect and reference episodes fitted together: what they share, and what is different in the suspect ones.

Unknowns: base (8: how the sensors stand in the reference), levers (3 a particle), change (8 + 3: delay, scale, turn,
shift, gripper offset of the suspect episodes). A fit frees some of the changes. Everything is a sum over episodes, so
that leaving one out (jackknife) costs one small solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pred_core.diagnose.gate_fit import GLOBAL, Normal, Point, normal_equations, typical_noise
from pred_core.diagnose.gate_tracks import HeldTrack
from pred_core.types import Array

OFFSET = slice(GLOBAL, GLOBAL + 3)  # [m] in the gripper's frame, after the shared unknowns
CHANGES = GLOBAL + 3
PRIOR = np.ones(CHANGES)  # [s], 1, [rad], [m], [m]: only for what the data leave open
LEVER_PRIOR = 1.0  # [m]
KNOWN_LEVER = 5e-4  # [m] deviation of a lever that the twin stores
FIXED = 1e-9
DELAYS = np.arange(-0.1, 0.41, 0.02)  # [s] where the fit may start
CLOSE = 1e-5  # [s], 1, [rad], [m]: a step this small ends the rounds
ROUNDS = 6  # Gauss-Newton steps; four are enough for 0.25 s of delay


@dataclass(frozen=True)
class Fit:
    """Changes of the suspect episodes, with what is left unexplained."""

    change: Array  # (CHANGES,)
    covariance: Array  # (CHANGES, CHANGES) by leaving out one episode at a time
    white: Array  # (CHANGES,) deviation [as the change] if errors were independent: what the data could show
    losses: Array  # (episodes,) of the suspect episodes, sum of squares over the noise
    step: Array  # (U,) from the point, all unknowns


class Joint:
    """Suspect and reference episodes about one point. `levers` known from a twin, or None."""

    def __init__(
        self,
        suspect: list[list[HeldTrack]],
        reference: list[list[HeldTrack]],
        levers: dict[int, Array] | None,
        slide_axis: int | None = None,
        near: Joint | None = None,
    ):
        self.suspect, self.reference, self.slide_axis = suspect, reference, slide_axis
        self.ids = sorted({t.id for e in suspect + reference for t in e})
        self.known = levers
        places = np.concatenate([t.place for e in suspect + reference for t in e])
        self.center = places.mean(axis=0)
        self.unknowns = GLOBAL + 3 * len(self.ids) + CHANGES
        self._prior = self._deviations()
        self._linearise(near)

    @property
    def episodes(self) -> int:
        """Suspect and reference episodes."""
        return len(self.suspect) + len(self.reference)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the jackknife covariance."""
        return len(self.suspect) - 1 + max(len(self.reference) - 1, 0)

    @property
    def offset_known(self) -> bool:
        """True if a change of the levers can be told from the levers."""
        common = {t.id for e in self.suspect for t in e} & {t.id for e in self.reference for t in e}
        return bool(common) or (self.known is not None and bool(set(self.known) & set(self.ids)))

    def fit(self, free: Array) -> Fit:
        """Free the changes `free` (CHANGES,) bool; the others stay zero."""
        active = np.concatenate((np.ones(self.unknowns - CHANGES, bool), free))
        start = -self.at * ~active  # inactive changes go to zero
        parts = self._parts
        total_m = sum(p.matrix for p in parts) + np.diag(1.0 / self._prior**2)
        total_g = sum(p.gradient for p in parts) - self.at_offset / self._prior**2
        step = self._solve(total_m, total_g, active, start)
        alone = np.empty((len(parts), CHANGES))
        for k, part in enumerate(parts):
            alone[k] = self._solve(total_m - part.matrix, total_g - part.gradient, active, start)[-CHANGES:]
        covariance = np.zeros((CHANGES, CHANGES))
        count = len(self.suspect)
        for group in (alone[:count], alone[count:]):
            if len(group) > 1:
                off = group - group.mean(axis=0)
                covariance += (len(group) - 1) / len(group) * off.T @ off
        inverse = np.zeros((self.unknowns, self.unknowns))
        own = total_m[np.ix_(active, active)]
        size = _sizes(own)
        inverse[np.ix_(active, active)] = np.linalg.inv(own / np.outer(size, size)) / np.outer(size, size)
        white = inverse[-CHANGES:, -CHANGES:]
        losses = np.array([p.loss(step) for p in parts[:count]])
        change = (self.at + step)[-CHANGES:]
        return Fit(change, covariance + white, np.sqrt(np.diag(white)), losses, step)

    def slides(self, fit: Fit) -> list[Array]:
        """Knots [m] of the sliding path of every episode, suspect first."""
        return [s.slide + s.slide_change @ (m @ fit.step) for s, m in zip(self._normals, self._maps, strict=True)]

    def _deviations(self) -> Array:
        base = np.full(GLOBAL, FIXED) if not self.reference else PRIOR[:GLOBAL].copy()
        levers = np.full((len(self.ids), 3), LEVER_PRIOR)
        if self.known is not None and not self.reference:
            for k, id in enumerate(self.ids):
                if id in self.known:
                    levers[k] = KNOWN_LEVER
        return np.concatenate((base, levers.ravel(), PRIOR))

    def _linearise(self, near: Joint | None) -> None:
        """Gauss-Newton with every change free, from the point of a fit `near`, else from the best of a few delays."""
        k = len(self.ids)
        self.at = np.zeros(self.unknowns)
        levers = np.zeros((k, 3))
        for i, id in enumerate(self.ids):
            # the lever of the reference where it has this particle, or the twin's, or the suspect's own
            group = [t for e in self.reference for t in e if t.id == id] or [
                t for e in self.suspect for t in e if t.id == id
            ]
            if self.known is not None and not self.reference and id in self.known:
                levers[i] = self.known[id]
                continue
            own = [np.einsum("tji,tj->ti", t.axes, t.measured - t.place) for t in group]
            levers[i] = np.nanmedian(np.concatenate(own), axis=0)
        self.at[GLOBAL : GLOBAL + 3 * k] = levers.ravel()
        self._mean = self.at.copy()
        if near is None:
            self.at[-CHANGES] = self._first_delay()
        else:
            self.at = near.at.copy()
        for _ in range(ROUNDS):
            self._refresh()
            free = np.ones(CHANGES, bool)
            free[OFFSET] = self.offset_known
            matrix = sum(p.matrix for p in self._parts) + np.diag(1.0 / self._prior**2)
            gradient = sum(p.gradient for p in self._parts) - self.at_offset / self._prior**2
            active = np.concatenate((np.ones(self.unknowns - CHANGES, bool), free))
            step = self._solve(matrix, gradient, active, np.zeros(self.unknowns))
            limit = np.full(self.unknowns, np.inf)
            limit[[0, -CHANGES]] = 0.1  # [s]
            limit[[1, 1 - CHANGES]] = 0.2
            self.at = self.at + np.clip(step, -limit, limit)
            if np.abs(step).max() < CLOSE:
                break
        self._refresh()

    def _first_delay(self) -> float:
        best, chosen = np.inf, 0.0
        for delay in DELAYS:
            self.at[-CHANGES] = delay
            point = self._point(True)
            noise = typical_noise(self.suspect, self.ids, point, self.center)
            if noise < best - 1e-9 or (abs(noise - best) <= 1e-9 and abs(delay) < abs(chosen)):
                best, chosen = noise, float(delay)
        return chosen

    def _point(self, suspect: bool) -> Point:
        z = self._map(suspect) @ self.at
        return Point(z[:GLOBAL], z[GLOBAL:].reshape(-1, 3))

    def _map(self, suspect: bool) -> Array:
        """(q, U): an episode's own unknowns from all unknowns."""
        q = self.unknowns - CHANGES
        m = np.zeros((q, self.unknowns))
        m[:, :q] = np.eye(q)
        if suspect:
            m[:GLOBAL, q : q + GLOBAL] = np.eye(GLOBAL)
            for k in range(len(self.ids)):
                m[GLOBAL + 3 * k : GLOBAL + 3 * k + 3, q + GLOBAL :] = np.eye(3)
        return m

    def _refresh(self) -> None:
        """Equations of every episode about the current point, in all unknowns."""
        self._normals, self._maps, self._parts = [], [], []
        for suspect, episodes in ((True, self.suspect), (False, self.reference)):
            if not episodes:
                continue
            point, m = self._point(suspect), self._map(suspect)
            noise = typical_noise(episodes, self.ids, point, self.center)
            if suspect:
                self.noise = noise  # [m] of the suspect episodes
            for tracks in episodes:
                own = normal_equations(tracks, self.ids, point, self.center, noise, self.slide_axis)
                self._normals.append(own)
                self._maps.append(m)
                self._parts.append(Normal(m.T @ own.matrix @ m, m.T @ own.gradient, own.misfit, own.count))

    @property
    def at_offset(self) -> Array:
        """(U,) how far the point lies from the prior's mean."""
        return self.at - self._mean

    def _solve(self, matrix: Array, gradient: Array, active: Array, start: Array) -> Array:
        step = start.copy()
        right = gradient - matrix @ start
        own = matrix[np.ix_(active, active)]
        size = _sizes(own)
        step[active] = start[active] + np.linalg.solve(own / np.outer(size, size), right[active] / size) / size
        return step


def _sizes(matrix: Array) -> Array:
    """Square roots of the diagonal: unknowns differ by many orders of magnitude. The priors leave at least 1."""
    return np.sqrt(np.maximum(np.diag(matrix), 1.0))

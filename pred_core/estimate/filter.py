"""A Kalman filter of the model's error, in the smooth modes of the body.

The error of a mode is its amplitude and its velocity; the velocity dies away over `memory` and is pushed at random,
the amplitude is its integral. The three axes share one covariance. All gains follow from it: how far a seen particle
takes hidden ones along, how much velocity a correction of position brings, how much more is believed after a pause.
Cost: O M^2 + M^3 for O tracks and M modes (Woodbury's identity), whatever the number of particles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.modes import Modes
from pred_core.types import Array


@dataclass(frozen=True)
class Evidence:
    """Tracks of one instant beside what the model expects there."""

    index: NDArray[np.int64]  # (O,) particles
    innovation: Array  # (O, 3) [m] measured minus expected
    variance: Array  # (O,) [m^2] of a track's coordinate

    def only(self, chosen: NDArray[np.bool_]) -> Evidence:
        """Some of it."""
        return Evidence(self.index[chosen], self.innovation[chosen], self.variance[chosen])


@dataclass(frozen=True)
class Correction:
    """What to add to the state."""

    position: Array  # (N, 3) [m]
    velocity: Array  # (N, 3) [m/s]


class ErrorFilter:
    """Covariance (2 M, 2 M) of amplitudes [m^2] and their velocities."""

    def __init__(self, modes: Modes, config: EstimatorConfig):
        self.modes, self._config = modes, config
        self._count = len(modes.variance)
        start = (config.start_position**2, config.start_velocity**2)
        self._covariance: Array = np.diag(np.concatenate([s * modes.variance for s in start]))

    def predict(self, seconds: float) -> None:
        """Let the errors grow for a time [s] (an Ornstein-Uhlenbeck velocity, integrated exactly)."""
        tau, dt = self._config.memory, max(seconds, 0.0)
        strength = 2.0 * self._config.push**2 * tau  # [m^2/s^3] white, of a push that lasts `memory`
        a = math.exp(-dt / tau)
        vv = strength * tau / 2.0 * (1.0 - a * a)
        xv = strength * tau**2 / 2.0 * (1.0 - a) ** 2
        xx = strength * tau**2 * (dt - 2.0 * tau * (1.0 - a) + tau / 2.0 * (1.0 - a * a)) + self._config.drift**2 * dt
        step = np.kron(np.array([[1.0, tau * (1.0 - a)], [0.0, a]]), np.eye(self._count))
        grown = np.kron(np.array([[xx, xv], [xv, vv]]), np.diag(self.modes.variance))
        self._covariance = np.asarray(step @ self._covariance @ step.T + grown)

    def variance(self) -> Array:
        """(N,) [m^2] of a coordinate of each particle."""
        return self._variance_at(self.modes.shape)

    def expected(self, evidence: Evidence) -> Array:
        """(O,) [m^2] variance of each innovation."""
        return self._variance_at(self.modes.shape[evidence.index]) + evidence.variance

    def apart(self, evidence: Evidence) -> Array:
        """(O,) squared distance, in standard deviations, of each track from what all others and the model say of it.

        With S the covariance of the innovations e: (S^-1 e)_i^2 / (S^-1)_ii, chi-squared with three degrees of freedom.
        """
        h, w = self.modes.shape[evidence.index], 1.0 / evidence.variance
        m = self._count
        gain = np.linalg.solve(np.eye(m) + self._covariance[:m, :m] @ (h.T * w) @ h, self._covariance[:m, :m])
        hg = h @ gain
        weighted = w[:, None] * (evidence.innovation - hg @ (h.T @ (w[:, None] * evidence.innovation)))
        diagonal = w - w * w * (hg * h).sum(axis=1)
        return (weighted**2).sum(axis=1) / np.maximum(diagonal, 1e-12 * w)

    def update(self, evidence: Evidence) -> Correction:
        """Take the evidence in; returns what it says of every particle."""
        h, w = self.modes.shape[evidence.index], 1.0 / evidence.variance
        m = self._count
        seen = (h.T * w) @ h
        right = np.concatenate((h.T @ (w[:, None] * evidence.innovation), seen @ self._covariance[:m]), axis=1)
        solved = np.linalg.solve(np.eye(m) + seen @ self._covariance[:m, :m], right)
        amplitude = self._covariance[:, :m] @ solved[:, :3]
        after: Array = self._covariance - self._covariance[:, :m] @ solved[:, 3:]
        self._covariance = 0.5 * (after + after.T)
        return Correction(self.modes.shape @ amplitude[:m], self.modes.shape @ amplitude[m:])

    def _variance_at(self, shape: Array) -> Array:
        return ((shape @ self._covariance[: self._count, : self._count]) * shape).sum(axis=1)

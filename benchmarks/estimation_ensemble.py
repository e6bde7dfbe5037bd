"""The other way to follow a state, for comparison: an ensemble Kalman filter of K worlds in one batch.

The worlds' spread is the covariance (Evensen 1994, perturbed observations), tapered along the body so that few worlds
do not invent correlations between far particles. Unknown pushes are drawn in the same smooth modes as the estimator's;
the gate against the model, late tracks, memory and lengths are the same. Nothing in the suite uses it.
"""

from __future__ import annotations

import numpy as np
import torch

from pred_core.dynamics import Dynamics, corrected
from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.history import NS, History, Node
from pred_core.estimate.lengths import Lengths
from pred_core.estimate.measurement import Measurement
from pred_core.estimate.modes import error_modes
from pred_core.types import Array, Body, Grip, State

WORLDS = 24
TAPER = 0.25  # [m] along the body


class Ensemble:
    """As `Estimator`: `start`, `step`, `correct`; `state` is the mean of the worlds."""

    def __init__(self, dynamics: Dynamics, body: Body, config: EstimatorConfig, seed: int = 0):
        self._dynamics, self._body, self._config = dynamics, body, config
        self._generator = np.random.default_rng(seed)
        self._history = History(config.history)
        arc = np.concatenate(([0.0], np.cumsum(body.rest_length)))
        self._taper = np.exp(-(((arc[:, None] - arc) / TAPER) ** 2))

    @property
    def state(self) -> State:
        """The mean."""
        worlds = self._history.newest.state
        return State(worlds.position.mean(0), worlds.velocity.mean(0), worlds.held[0])

    def start(self, stamp: int, state: State, grip: Grip) -> None:
        """Spread worlds about a start."""
        held = (state.held >= 0).numpy()
        modes = error_modes(self._body, held, self._config.correlation, self._config.modes)
        self._lengths = Lengths(self._body, (~held).astype(np.float64))
        self._shape = modes.shape * np.sqrt(modes.variance)
        worlds = State(
            state.position + self._drawn(self._config.start_position),
            state.velocity + self._drawn(self._config.start_velocity),
            state.held.expand(WORLDS, -1).clone(),
        )
        self._push = self._drawn(self._config.push)  # (K, N, 3) [m/s^2], as long as it lasts
        self._history.add(Node(stamp, self._dynamics.start(worlds, grip), grip))

    def step(self, stamp: int, grip: Grip) -> State:
        """One period of all worlds, each with its own slowly changing push."""
        dt, tau = self._dynamics.period, self._config.memory
        keep = float(np.exp(-dt / tau))
        self._push = keep * self._push + np.sqrt(1.0 - keep * keep) * self._drawn(self._config.push)
        worlds = self._history.newest.state
        moved = worlds.replace(velocity=worlds.velocity + dt * self._push)
        self._history.add(Node(stamp, self._dynamics.step(moved, grip), grip))
        return self.state

    def correct(self, seen: Measurement) -> None:
        """Correct all worlds at the time of the tracks, and simulate on."""
        at = self._history.before(seen.stamp)
        node = self._history.node(at)
        usable = (seen.confidence > self._config.least_confidence) & (node.state.held[0] < 0).numpy()[seen.index]
        index, measured = seen.index[usable], seen.position[usable]
        variance = np.full(len(index), seen.variance(self._config)[0])
        place = self._history.position_at(at, seen.stamp)
        off = (measured - place.mean(0)[index]) ** 2
        kept = off.sum(1) <= self._config.gate**2 * (place.var(0, ddof=1)[index].mean(1) + variance)
        index, measured, variance = index[kept], measured[kept], variance[kept]
        if len(index):
            self._apply(at, index, measured, variance, place, (seen.stamp - node.stamp) / NS)

    def _apply(self, at: int, index: Array, measured: Array, variance: Array, place: Array, later: float) -> None:
        node, *after = self._history.cut(at)
        velocity = node.state.velocity.double().numpy()
        noisy = measured + np.sqrt(variance)[:, None] * self._generator.normal(size=(WORLDS, *measured.shape))
        x, v = place - place.mean(0), velocity - velocity.mean(0)
        taper = self._taper[:, index]
        near = taper[index]
        # One covariance for all three axes, as the estimator has it: the mean over the axes.
        spread = np.einsum("kia,kja->ij", x[:, index], x[:, index]) / (3 * (WORLDS - 1))
        solved = np.linalg.solve(near * spread + np.diag(variance), np.moveaxis(noisy - place[:, index], 0, 1)
                                 .reshape(len(index), -1))  # fmt: skip
        gain_x = taper * np.einsum("kia,kja->ij", x, x[:, index]) / (3 * (WORLDS - 1))
        gain_v = taper * np.einsum("kia,kja->ij", v, x[:, index]) / (3 * (WORLDS - 1))
        dx, dv = ((g @ solved).reshape(-1, WORLDS, 3).swapaxes(0, 1) for g in (gain_x, gain_v))
        before = node.state.position.double().numpy()
        after_x = np.stack([self._lengths.keep(b, b + c) for b, c in zip(before, dx - later * dv, strict=True)])
        after_v = np.stack([self._lengths.still(x, c) for x, c in zip(after_x, dv, strict=True)])
        state = corrected(
            self._dynamics,
            node.state,
            node.state.position + torch.as_tensor(after_x - before, dtype=torch.float32),
            node.state.velocity + torch.as_tensor(after_v, dtype=torch.float32),
        )
        self._history.add(Node(node.stamp, state, node.grip))
        for old in after:
            self.step(old.stamp, old.grip)

    def _drawn(self, size: float) -> torch.Tensor:
        """(K, N, 3) smooth random fields of a standard deviation."""
        field = self._shape @ self._generator.normal(size=(WORLDS, self._shape.shape[1], 3))
        return torch.as_tensor(size * field, dtype=torch.float32)

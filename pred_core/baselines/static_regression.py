"""Static regression: the shape as a quadratic function of the held particles' positions, without memory.

    x_free = W [1, h, h h^T] with h the stacked held positions; ridge on standardised features

It knows no velocity and no history; that it beats published networks on the measured cables is why it
belongs in every table. It is fitted on training episodes only; the ridge is chosen by predicting
recordings (or, with a single one, episodes) that were left out of the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.baselines.holding import attach, carried_position, carry
from pred_core.dynamics import rollout_by_steps
from pred_core.errors import DatasetError, InputError
from pred_core.metrics.correspondence import scored
from pred_core.types import Array, Episode, Grip, State

RIDGES = tuple(10.0**e for e in range(-6, 1))  # of the mean squared standardised feature
MAX_HELD = 8  # held particles used as features: 24 coordinates, 324 features


@dataclass(frozen=True)
class StaticRegression:
    """Fitted weights; see `fit_static_regression`."""

    period: float  # [s]
    held: NDArray[np.int32]  # (N,) gripper index it was fitted with, -1 = free
    features_from: NDArray[np.int64]  # (H,) held particles whose positions are the features
    ridge: float
    feature_mean: Tensor  # (F,)
    feature_scale: Tensor  # (F,)
    weights: Tensor  # (F, 3 N) [m]
    intercept: Tensor  # (3 N,) [m]

    def start(self, state: State, grip: Grip | None = None) -> State:
        """See `Dynamics.start`. Raises: InputError if other particles are held than in training."""
        held = (state.held >= 0).numpy(force=True)
        if held.shape[-1] != len(self.held) or not bool((held == (self.held >= 0)).all()):
            raise InputError(
                "static regression: other particles are held than in training",
                got=np.flatnonzero(held.reshape(-1, held.shape[-1])[0]).tolist(),
                allowed=np.flatnonzero(self.held >= 0).tolist(),
            )
        return attach(state, grip)

    def step(self, state: State, grip: Grip) -> State:
        """See `Dynamics.step`."""
        held = carried_position(state, grip)[..., self.features_from, :].double()
        features = (_quadratic(held.flatten(-2)) - self.feature_mean) / self.feature_scale
        shape = (features @ self.weights + self.intercept).to(state.position.dtype)
        return carry(state, grip, shape.unflatten(-1, (-1, 3)), self.period)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """See `Dynamics.rollout`."""
        return rollout_by_steps(self, state, grips)


def fit_static_regression(episodes: Sequence[Episode], folds: int = 5) -> StaticRegression:
    """Fit on `episodes`, all of them training data. Frames with a hidden particle are left out.

    Raises: DatasetError if there are fewer than two episodes, nothing is held, or what is held differs.
    """
    if len(episodes) < 2:
        raise DatasetError("static regression: too few training episodes", got=len(episodes), allowed="2 or more")
    held = episodes[0].held
    for episode in episodes:
        if not np.array_equal(episode.held >= 0, held >= 0):
            raise DatasetError(f"static regression: {episode.name} holds other particles than {episodes[0].name}")
    index = np.flatnonzero(held >= 0)
    if len(index) == 0:
        raise DatasetError("static regression: no particle is held", next_step="Leave this baseline out")
    if len(index) > MAX_HELD:
        index = index[np.linspace(0, len(index) - 1, MAX_HELD).round().astype(int)]
    shapes = [_measured(e) for e in episodes]
    features = [_quadratic(torch.as_tensor(s[:, index].reshape(len(s), -1))) for s in shapes]
    targets = [torch.as_tensor(s.reshape(len(s), -1)) for s in shapes]
    group = np.array([e.recording for e in episodes])
    if len(np.unique(group)) < 2:
        group = np.arange(len(episodes))
    ridge = _choose_ridge(features, targets, group, folds)
    mean, scale, weights, intercept = _solve(torch.cat(features), torch.cat(targets), (ridge,))[0]
    return StaticRegression(episodes[0].period, held, index, ridge, mean, scale, weights, intercept)


Fit = tuple[Tensor, Tensor, Tensor, Tensor]  # feature mean, feature scale, weights, intercept


def _choose_ridge(features: list[Tensor], targets: list[Tensor], group: NDArray[np.int_], folds: int) -> float:
    """The ridge with the least mean absolute error on groups left out of the fit."""
    groups = np.unique(group)
    error = np.zeros(len(RIDGES))
    for fold in range(min(folds, len(groups))):
        left_out = np.isin(group, groups[fold::folds])
        fits = _solve(_joined(features, ~left_out), _joined(targets, ~left_out), RIDGES)
        x, y = _joined(features, left_out), _joined(targets, left_out)
        for i, (mean, scale, weights, intercept) in enumerate(fits):
            error[i] += float(((x - mean) / scale @ weights + intercept - y).abs().sum())
    return RIDGES[int(error.argmin())]


def _solve(features: Tensor, targets: Tensor, ridges: Sequence[float]) -> list[Fit]:
    mean, scale = features.mean(0), features.std(0).clamp_min(1e-9)
    z, intercept = (features - mean) / scale, targets.mean(0)
    gram, moment = z.T @ z / len(z), z.T @ (targets - intercept) / len(z)
    eye = torch.eye(len(gram), dtype=gram.dtype)
    return [(mean, scale, torch.linalg.solve(gram + ridge * eye, moment), intercept) for ridge in ridges]


def _joined(parts: list[Tensor], chosen: NDArray[np.bool_]) -> Tensor:
    return torch.cat([p for p, c in zip(parts, chosen, strict=True) if c])


def _measured(episode: Episode) -> Array:
    """Frames in which every particle is measured, (T', N, 3) [m]."""
    whole = scored(episode.position, episode.tracks.visible).all(axis=-1)
    if not whole.any():
        raise DatasetError(f"static regression: {episode.name} has no frame in which every particle is measured")
    return np.asarray(episode.position[whole], dtype=np.float64)


def _quadratic(held: Tensor) -> Tensor:
    """[h, upper triangle of h h^T] of (..., M): (..., M + M (M+1)/2)."""
    rows, columns = torch.triu_indices(held.shape[-1], held.shape[-1])
    return torch.cat((held, held[..., rows] * held[..., columns]), dim=-1)

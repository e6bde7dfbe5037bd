"""Errors between corresponding particles. Hidden particles are left out and counted, never filled in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import InputError
from pred_core.types import Array


def mde(predicted: Array, measured: Array, visible: NDArray[np.bool_] | None = None) -> Array:
    """Mean distance error (`mde`): mean L2 distance over particles, (...,) [m].

    `predicted`, `measured` (..., P, 3) [m]; `visible` (..., P): particles to score. A frame in which no
    particle is measured scores NaN. Raises: InputError for a non-finite prediction or unequal shapes.
    """
    error, seen = _difference(predicted, measured, visible)
    return masked_mean(np.linalg.norm(error, axis=-1), seen)


def coordinate_l1(predicted: Array, measured: Array, visible: NDArray[np.bool_] | None = None) -> Array:
    """Mean absolute error per coordinate (`coordinate_l1`), the protocol of the measured cables, (...,) [m].

    Arguments as in `mde`. Source: DEFORM (arXiv 2406.05931), over all vertices, held ones included.
    """
    error, seen = _difference(predicted, measured, visible)
    return masked_mean(np.abs(error).mean(axis=-1), seen)


def scored(measured: Array, visible: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Which particles can be scored: flagged visible and with finite coordinates, (..., P)."""
    finite = np.isfinite(measured).all(axis=-1)
    return np.asarray(finite if visible is None else finite & visible)


def hidden_count(measured: Array, visible: NDArray[np.bool_] | None = None) -> int:
    """Number of particle-frames left out of a score."""
    return int((~scored(measured, visible)).sum())


def masked_mean(value: Array, mask: NDArray[np.bool_]) -> Array:
    """Mean over the last axis where `mask` holds, NaN where it holds nowhere."""
    count = mask.sum(axis=-1)
    total = np.where(mask, value, 0.0).sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _difference(
    predicted: Array, measured: Array, visible: NDArray[np.bool_] | None
) -> tuple[Array, NDArray[np.bool_]]:
    if predicted.shape != measured.shape or predicted.shape[-1] != 3:
        raise InputError("prediction and measurement differ in shape", got=predicted.shape, allowed=measured.shape)
    if not np.isfinite(predicted).all():
        raise InputError("the prediction is not finite", next_step="Report the model as diverged instead of scoring it")
    seen = scored(measured, visible)
    return np.where(seen[..., None], predicted - np.where(seen[..., None], measured, 0.0), 0.0), seen

"""Errors between object masks: region (J) and contour (F). Source: DAVIS benchmark (Perazzi et al. 2016)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, distance_transform_edt

from pred_core.errors import InputError

Mask = NDArray[np.bool_]


def region_j(predicted: Mask, measured: Mask) -> float:
    """`j_iou`: intersection over union of two masks (H, W). Two empty masks agree: 1."""
    _check(predicted, measured)
    union = np.logical_or(predicted, measured).sum()
    return 1.0 if union == 0 else float(np.logical_and(predicted, measured).sum() / union)


def contour_f(predicted: Mask, measured: Mask, tolerance: float = 0.008) -> float:
    """`f_contour`: F score of contour pixels matched within ceil(tolerance x image diagonal) pixels.

    Contours are the inner boundary pixels of the masks (H, W). Two empty masks agree: 1.
    """
    _check(predicted, measured)
    radius = math.ceil(tolerance * math.hypot(*predicted.shape))
    ours, theirs = _contour(predicted), _contour(measured)
    if not ours.any() and not theirs.any():
        return 1.0
    if not ours.any() or not theirs.any():
        return 0.0
    precision = (ours & _within(theirs, radius)).sum() / ours.sum()
    recall = (theirs & _within(ours, radius)).sum() / theirs.sum()
    total = precision + recall
    return 0.0 if total == 0 else float(2.0 * precision * recall / total)


def _contour(mask: Mask) -> Mask:
    # The object may touch the image border: outside the image counts as outside the object.
    return np.asarray(mask & ~binary_erosion(mask, border_value=0))


def _within(contour: Mask, radius: int) -> Mask:
    return np.asarray(distance_transform_edt(~contour) <= radius + 1e-9)


def _check(predicted: Mask, measured: Mask) -> None:
    if predicted.shape != measured.shape or predicted.ndim != 2:
        raise InputError("masks differ in shape", got=predicted.shape, allowed=measured.shape)
    for mask in (predicted, measured):
        if mask.dtype != np.bool_:
            raise InputError("a mask is not boolean", got=mask.dtype, allowed="bool")

"""Errors between images that need no learned weights: PSNR and MS-SSIM."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import correlate1d

from pred_core.errors import InputError
from pred_core.types import Array

# Wang, Simoncelli, Bovik 2003, "Multi-scale structural similarity": exponents of the five scales.
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(predicted: Array, measured: Array) -> float:
    """`psnr` [dB] of images (H, W) or (H, W, C) with values 0 to 1; infinite for equal images."""
    _check(predicted, measured)
    error = float(np.mean((predicted.astype(np.float64) - measured.astype(np.float64)) ** 2))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def ms_ssim(predicted: Array, measured: Array) -> float:
    """`ms_ssim` (0 to 1) of images (H, W) or (H, W, C) with values 0 to 1, averaged over channels.

    Five scales, Gaussian window 11 px sigma 1.5, valid region only. Source: Wang et al. 2003. Negative
    contrast terms are clipped at 0 before the power, as is usual. Raises: InputError if a side is below 176 px,
    where the fifth scale is smaller than the window.
    """
    _check(predicted, measured)
    least = _WINDOW * 2 ** (len(_SCALE_WEIGHTS) - 1)
    if min(predicted.shape[:2]) < least:
        raise InputError("ms_ssim: image too small", got=predicted.shape[:2], allowed=f"sides of {least} px or more")
    a = np.atleast_3d(predicted).astype(np.float64)
    b = np.atleast_3d(measured).astype(np.float64)
    return float(np.mean([_ms_ssim_channel(a[..., c], b[..., c]) for c in range(a.shape[2])]))


def _ms_ssim_channel(a: Array, b: Array) -> float:
    value = 1.0
    for scale, weight in enumerate(_SCALE_WEIGHTS):
        luminance, contrast = _ssim_terms(a, b)
        if scale == len(_SCALE_WEIGHTS) - 1:
            contrast *= luminance
        value *= max(contrast, 0.0) ** weight
        a, b = _halve(a), _halve(b)
    return value


def _ssim_terms(a: Array, b: Array) -> tuple[float, float]:
    """Mean (luminance term x contrast term) / mean contrast term, and mean contrast term."""
    mean_a, mean_b = _blur(a), _blur(b)
    var_a, var_b = _blur(a * a) - mean_a**2, _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    contrast = (2 * covariance + _C2) / (var_a + var_b + _C2)
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    mean_contrast = float(contrast.mean())
    joint = float((luminance * contrast).mean())
    return (joint / mean_contrast if mean_contrast != 0.0 else 0.0), mean_contrast


def _blur(image: Array) -> Array:
    offset = np.arange(_WINDOW) - _WINDOW // 2
    kernel = np.exp(-0.5 * (offset / _SIGMA) ** 2)
    kernel /= kernel.sum()
    margin = _WINDOW // 2
    blurred = correlate1d(correlate1d(image, kernel, axis=0), kernel, axis=1)
    return np.asarray(blurred[margin:-margin, margin:-margin], dtype=np.float64)


def _halve(image: Array) -> Array:
    rows, columns = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.asarray(image[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3)))


def _check(predicted: Array, measured: Array) -> None:
    if predicted.shape != measured.shape or predicted.ndim not in (2, 3):
        raise InputError("images differ in shape", got=predicted.shape, allowed=measured.shape)
    for image in (predicted, measured):
        if image.dtype.kind != "f" or not np.isfinite(image).all() or image.min() < 0.0 or image.max() > 1.0:
            raise InputError("an image is not finite floats 0 to 1", got=image.dtype, next_step="Divide bytes by 255")

"""What a stereo camera makes of true depth: disparity noise, holes along edges, dropouts, whole millimetres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import ndtri

from pred_core.config import setting

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class StereoNoise:
    """Depth errors of a stereo pair. `NO_NOISE` has none."""

    disparity: float = setting(0.08, unit="px", low=0.0, high=2.0, doc="standard deviation of the disparity")
    baseline: float = setting(0.095, unit="m", low=0.01, high=1.0, doc="between the two imagers")
    edge: float = setting(0.02, unit="m", low=1e-3, high=1.0, doc="a step in depth that is an edge")
    holes: float = setting(0.5, low=0.0, high=1.0, doc="share of the pixels beside an edge without depth")
    dropout: float = setting(0.01, low=0.0, high=1.0, doc="share of all pixels without depth")
    quantum: float = setting(0.001, unit="m", low=0.0, high=0.1, doc="step of the depth values")


NO_NOISE = StereoNoise(disparity=0.0, holes=0.0, dropout=0.0, quantum=0.0)


def add_noise(depth: Depth, focal: float, noise: StereoNoise, generator: np.random.Generator) -> Depth:
    """Measured depth (H, W) [m] of true depth (H, W) [m], NaN = none; `focal` [px].

    Depth z is disparity f b / z, so an error of e [px] in it is z^2 e / (f b) in depth.
    """
    shape = depth.shape
    inverse = np.float32(1.0 / (focal * noise.baseline))
    measured = depth / (1.0 + np.float32(noise.disparity) * inverse * depth * _smooth(generator, shape))
    if noise.holes > 0.0:
        step = maximum_filter(depth, 3) - minimum_filter(depth, 3)
        # Matching fails in patches rather than in single pixels; a normal value below 0 is half of them.
        measured[(step > noise.edge) & (_smooth(generator, shape) < ndtri(noise.holes))] = np.nan
    if noise.dropout > 0.0:
        measured[generator.random(shape, dtype=np.float32) < noise.dropout] = np.nan
    if noise.quantum > 0.0:
        measured = np.round(measured / np.float32(noise.quantum)) * np.float32(noise.quantum)
    return measured.astype(np.float32, copy=False)


def _smooth(generator: np.random.Generator, shape: tuple[int, ...]) -> Depth:
    """Normal noise of standard deviation 1, correlated over 3 x 3 pixels as block matching makes it."""
    height, width = shape
    white = generator.standard_normal((height + 2, width + 2), dtype=np.float32)
    rows = white[:-2] + white[1:-1] + white[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / np.float32(3.0)

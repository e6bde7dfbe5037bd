"""Tracks as the estimator takes them, and what became of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.estimate.config import EstimatorConfig
from pred_core.types import Array


@dataclass(frozen=True)
class Measurement:
    """Tracks of one instant, by particle of the body."""

    stamp: int  # [ns] capture time
    index: NDArray[np.int64]  # (O,) particles, each once
    position: Array  # (O, 3) [m] world
    confidence: Array  # (O,) 0 to 1

    def variance(self, config: EstimatorConfig) -> Array:
        """(O,) [m^2] of a coordinate: what every track has, and what its confidence says."""
        told = config.confidence_scale * np.log(np.maximum(self.confidence, 1e-6))
        return config.noise**2 + told**2


@dataclass(frozen=True)
class Outcome:
    """What became of a measurement."""

    stamp: int  # [ns] its own
    index: NDArray[np.int64]  # (O,) particles it could have corrected: seen well enough, and not held
    used: NDArray[np.bool_]  # (O,) the others were taken for wrong
    innovation: float  # [m] median distance between tracks and model, of all
    late: bool = False  # older than the history: nothing was done with it
    anew: bool = False  # most tracks had contradicted the state for too long: it was made anew out of tracks

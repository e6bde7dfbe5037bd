"""What the tracker says about one instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pred_core.types import Array, Tracks

Status = Literal["searching", "tracking", "lost"]


@dataclass(frozen=True)
class Estimate:
    """Particles with their uncertainty. The stamp in `tracks` is a capture time, never the time of arrival."""

    tracks: Tracks  # one instant
    covariance: Array  # (P, 3, 3) [m^2]
    velocity: Array  # (P, 3) [m/s] world
    status: Status
    residual: float  # [m] root mean square distance of the points that were used
    cameras: tuple[str, ...]  # whose pictures went in


@dataclass(frozen=True)
class Prior:
    """Where the predictor expects particles."""

    stamp: int  # [ns]
    id: NDArray[np.uint32]  # (P,)
    position: Array  # (P, 3) [m] world
    velocity: Array  # (P, 3) [m/s]
    sigma: float  # [m] standard deviation of a coordinate


def trace_confidence(covariance: Array, visible: NDArray[np.bool_], scale: float = 0.01) -> NDArray[np.float32]:
    """Confidence (P,) in 0..1 of covariances (P, 3, 3): exp(-standard deviation / scale); half that where unseen."""
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)
    value = np.exp(-sigma / scale) * np.where(visible, 1.0, 0.5)
    return np.clip(value, 0.01, 1.0).astype(np.float32)

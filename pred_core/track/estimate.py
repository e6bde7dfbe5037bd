"""What the tracker says about one instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pred_core.types import Array, Tracks

ODD_FACTOR, ODD_LEAST = 1.6, 0.004  # times the others' distance, [m]
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
    off: tuple[float, ...] = ()  # [m] median distance between the object and what each of them sees of it
    slipped: bool = False  # the object was held when it was found, and is not any more

    def odd_camera(self) -> tuple[str, float] | None:
        """The camera that sees the object elsewhere than the others do, and by how much [m]: it has been moved."""
        odd = odd_one(np.array(self.off))
        return None if odd is None else (self.cameras[odd], self.off[odd])


@dataclass(frozen=True)
class Prior:
    """Where the predictor expects particles."""

    stamp: int  # [ns]
    id: NDArray[np.uint32]  # (P,)
    position: Array  # (P, 3) [m] world
    velocity: Array  # (P, 3) [m/s]
    sigma: float  # [m] standard deviation of a coordinate


def odd_one(off: Array) -> int | None:
    """The camera whose distance (V,) [m] from the object stands out. Of two, nobody knows which one is wrong."""
    known = np.flatnonzero(np.isfinite(off))
    if len(known) < 3:
        return None
    worst = int(known[np.argmax(off[known])])
    rest = float(np.median(off[known[known != worst]]))
    return worst if off[worst] > max(ODD_FACTOR * rest, ODD_LEAST) else None


def trace_confidence(covariance: Array, visible: NDArray[np.bool_], scale: float = 0.01) -> NDArray[np.float32]:
    """Confidence (P,) in 0..1 of covariances (P, 3, 3): exp(-standard deviation / scale); half that where unseen."""
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)
    value = np.exp(-sigma / scale) * np.where(visible, 1.0, 0.5)
    return np.clip(value, 0.01, 1.0).astype(np.float32)

"""Tracks as the estimator takes them, and what became of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import InputError
from pred_core.estimate.config import EstimatorConfig
from pred_core.types import Array


@dataclass(frozen=True)
class Measurement:
    """Tracks of one instant, by particle of the body.

    A particle that was not measured is left out, or has confidence 0: then its position is not read. A position that is
    not finite at any other confidence is an error of who sends it (`check`), not a wrong track.
    """

    stamp: int  # [ns] capture time
    index: NDArray[np.int64]  # (O,) particles, each once
    position: Array  # (O, 3) [m] world
    confidence: Array  # (O,) 0 to 1

    def check(self, count: int) -> None:
        """Raise InputError for what cannot be tracks of a body of `count` particles."""
        o = len(self.index)
        if self.position.shape != (o, 3) or self.confidence.shape != (o,):
            raise InputError(
                "tracks of unequal numbers",
                got=f"index {self.index.shape}, position {self.position.shape}, confidence {self.confidence.shape}",
                allowed="(O,), (O, 3), (O,)",
            )
        if o and (self.index.min() < 0 or self.index.max() >= count or len(np.unique(self.index)) < o):
            got = f"{o} tracks of {self.index.min()} to {self.index.max()}, {len(np.unique(self.index))} different ones"
            raise InputError("tracks of particles", got=got, allowed=f"each of 0 to {count - 1} once")
        strange = ~((self.confidence >= 0.0) & (self.confidence <= 1.0))  # also NaN
        if strange.any():
            k = int(np.flatnonzero(strange)[0])
            raise InputError(
                f"the confidence of particle {int(self.index[k])}", got=float(self.confidence[k]), allowed="0 to 1"
            )
        absent = ~np.isfinite(self.position).all(axis=1) & (self.confidence > 0.0)
        if absent.any():
            k = int(np.flatnonzero(absent)[0])
            raise InputError(
                f"the track of particle {int(self.index[k])} is not finite",
                got=f"{self.position[k].tolist()} at confidence {float(self.confidence[k]):g}",
                allowed="finite metres; confidence 0 where nothing was measured",
                next_step="Leave particles out that were not measured",
            )

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

"""Whether the estimate can be trusted: lost when most tracks contradict it for a while, blind when there are none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.history import NS

Level = Literal["ok", "blind", "stopped"]


@dataclass
class Tally:
    """What was done with the tracks so far."""

    frames: int = 0  # that corrected the state
    late: int = 0  # frames older than the history
    used: int = 0  # particles
    rejected: int = 0  # particles whose tracks were taken for wrong
    lost: int = 0  # times it started anew because most tracks contradicted the state
    let_go: int = 0  # held particles that were elsewhere then


class Health:
    """Fed with the outcome of every frame; all times are stamps [ns]."""

    def __init__(self, config: EstimatorConfig, stamp: int):
        self._config = config
        self._used = stamp  # of the newest frame that corrected the state
        self._doubted: int | None = None  # since when most tracks contradict it

    def note(self, stamp: int, used: int, rejected: int) -> None:
        """A frame of which so many particles were used and rejected."""
        seen = used + rejected
        if seen and rejected >= self._config.lost_share * seen:
            self._doubted = stamp if self._doubted is None else self._doubted
        elif seen:
            self._doubted = None
        if used:
            self._used = max(self._used, stamp)

    def lost(self, stamp: int) -> bool:
        """Most tracks have contradicted the state for `lost_after`."""
        return self._doubted is not None and stamp - self._doubted >= self._config.lost_after * NS

    def blind_for(self, stamp: int) -> float:
        """[s] since the last frame that corrected the state."""
        return max(0, stamp - self._used) / NS

    def level(self, stamp: int) -> Level:
        """ok; blind: the model alone; stopped: for too long to give a state."""
        blind = self.blind_for(stamp)
        return "stopped" if blind > self._config.stop_after else "blind" if blind > self._config.warn_after else "ok"

"""How long the rest of some pieces takes, at the pace so far; pieces from the journal take no time and do not count."""

from __future__ import annotations

import time
from collections.abc import Callable

from pred_core.diagnose.journal import Journal


class Pace:
    """Made before the first of `total` pieces, which must all be the journal's."""

    def __init__(self, total: int, journal: Journal, clock: Callable[[], float] = time.monotonic):
        self.total, self._journal, self._clock = total, journal, clock
        self._begin, self._replayed = clock(), journal.replayed

    def left(self, done: int) -> str:
        """", about 12 s left" once `done` pieces are finished; "" where nothing is known yet, or nothing is left."""
        fresh = done - (self._journal.replayed - self._replayed)
        if fresh <= 0 or done >= self.total:
            return ""
        return f", about {(self._clock() - self._begin) / fresh * (self.total - done):.0f} s left"

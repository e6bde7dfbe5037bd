"""The stamps of several topics on one time line that may jump back: a bag played in a loop begins a new lap.

All topics share the laps, so that data of one instant always compare equal in time. One stamp out of line (a sender
whose clock was wrong for a moment) must neither begin a lap nor stay in the way of what follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from pred_core.errors import InputError

AHEAD = 10_000_000_000  # [ns] a stamp further ahead of everything seen is believed when the next one confirms it
Time = tuple[int, int]  # (lap, stamp [ns])
T = TypeVar("T")


@dataclass
class _Topic(Generic[T]):
    """Where one topic stands."""

    lap: int
    newest: int  # [ns]
    left_at: int | None = None  # [ns] its newest stamp when another topic began a newer lap
    fell_from: int | None = None  # [ns] its newest stamp before it began a lap that no other topic has followed into


class Laps(Generic[T]):
    """Gives every message its place in time; `late` [s]: a smaller step back is a late message, not a new lap."""

    def __init__(self, late: float):
        self._late = round(late * 1e9)
        self._topics: dict[str, _Topic[T]] = {}
        self._held: dict[str, tuple[int, T]] = {}

    def clear(self) -> None:
        """Forget every stamp."""
        self._topics.clear()
        self._held.clear()

    def take(self, topic: str, stamp: int, item: T) -> list[tuple[Time, T]]:
        """The message, after the one it confirms if there is one, each with its place in time.

        A time at or before an earlier one of the topic means that what came at later times was out of line.
        Raises: InputError for a late or repeated message, and for one far ahead, which is held back until the next.
        """
        own = self._topics.get(topic)
        if own is not None and self._is_back(own, stamp):
            self._undo_lap(own)
        held = self._held.pop(topic, None)
        if held is not None and 0 < stamp - held[0] <= AHEAD:
            return [(self._place(topic, held[0]), held[1]), (self._place(topic, stamp), item)]
        newest = self._newest(topic)
        if newest is not None and stamp - newest > AHEAD:
            self._held[topic] = (stamp, item)
            raise InputError(
                f"{topic}: time jumps {(stamp - newest) * 1e-9:.3f} s ahead",
                got=f"stamp {stamp * 1e-9:.6f} s after {newest * 1e-9:.6f} s",
                allowed=f"{AHEAD * 1e-9:g} s",
                next_step="It is used only if the next message confirms it; check the sender's clock",
            )
        return [(self._place(topic, stamp), item)]

    def _newest(self, topic: str) -> int | None:
        """The newest stamp [ns] of the lap that the topic is in, over all topics."""
        own = self._topics.get(topic)
        lap = own.lap if own is not None else self._last_lap()
        return max((t.newest for t in self._topics.values() if t.lap == lap), default=None)

    def _last_lap(self) -> int:
        return max((t.lap for t in self._topics.values()), default=0)

    def _place(self, topic: str, stamp: int) -> Time:
        own = self._topics.get(topic)
        if own is None:
            own = self._topics[topic] = _Topic(self._last_lap(), stamp)
            self._join(own)
        elif stamp > own.newest:
            if own.left_at is not None and stamp - own.left_at > AHEAD:
                self._join(own)  # it went on so long without jumping back: the other topic's lap was no loop
        else:
            if own.newest - stamp <= self._late:
                raise InputError(
                    f"{topic}: time runs backwards",
                    got=f"stamp {stamp * 1e-9:.6f} s after {own.newest * 1e-9:.6f} s",
                )
            if own.lap < self._last_lap():
                self._join(own)
            elif self._is_loop(own, stamp):
                self._begin_lap(own)
        own.newest = stamp
        return own.lap, stamp

    def _is_loop(self, own: _Topic[T], stamp: int) -> bool:
        """False if this topic was ahead of all others by itself and now comes back to them."""
        others = [t for t in self._topics.values() if t is not own and t.lap == own.lap]
        return not others or any(abs(own.newest - t.newest) <= abs(t.newest - stamp) for t in others)

    def _begin_lap(self, own: _Topic[T]) -> None:
        own.lap, own.fell_from = own.lap + 1, own.newest
        for other in self._topics.values():
            if other is not own and other.left_at is None:
                other.left_at = other.newest

    def _is_back(self, own: _Topic[T], stamp: int) -> bool:
        """True if this topic alone began a lap and now goes on where it was before: no loop, but stamps out of line."""
        if own.fell_from is None or not 0 < stamp - own.fell_from <= AHEAD:
            return False
        return stamp - own.newest > self._late

    def _undo_lap(self, own: _Topic[T]) -> None:
        assert own.fell_from is not None  # `_is_back`
        own.lap, own.newest, own.fell_from = own.lap - 1, own.fell_from, None
        for other in self._topics.values():
            if other.lap == own.lap:
                other.left_at = None

    def _join(self, own: _Topic[T]) -> None:
        own.lap, own.left_at = self._last_lap(), None
        for topic in self._topics.values():
            topic.fell_from = None

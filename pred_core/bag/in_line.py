"""One topic's messages on their time line: a single stamp out of line is refused by name, a new line is followed."""

from __future__ import annotations

from typing import Generic, TypeVar

from pred_core.errors import InputError

NS = 1e9
CONFIRMS = 10.0  # [s] at most between a message that waits and the next one on its line, however slow that is
T = TypeVar("T")


class InLine(Generic[T]):
    """A message whose stamp is more than `back` [s] before the newest, or more than `ahead` [s] after it, waits for the
    next one: if that follows it, a new line has begun (a loop, a clock set anew, the end of a hole) and nothing is
    lost; if it goes on from the newest, the stamp was wrong.
    """

    def __init__(self, topic: str, back: float, ahead: float):
        self._topic, self._back, self._ahead = topic, round(back * NS), round(ahead * NS)
        self._newest: int | None = None  # [ns]
        self._held: tuple[int, T] | None = None

    def clear(self) -> None:
        """Forget every stamp."""
        self._newest = self._held = None

    def take(self, stamp: int, item: T) -> tuple[list[T], InputError | None]:
        """What can be used now, oldest first, and why the message before this one cannot, where it was out of line."""
        held, self._held = self._held, None
        wrong = None if held is None or self._newest is None else self._refusal(held[0], self._newest)
        if self._newest is None or -self._back <= stamp - self._newest <= self._ahead:
            self._newest = stamp if self._newest is None else max(stamp, self._newest)
            return [item], wrong
        if held is not None and 0 <= stamp - held[0] <= CONFIRMS * NS:
            self._newest = stamp
            return [held[1], item], None
        self._held = stamp, item
        return [], wrong

    def _refusal(self, stamp: int, newest: int) -> InputError:
        return InputError(
            f"{self._topic}: one stamp is out of line",
            got=f"{(stamp - newest) / NS:+.3f} s from the one before",
            allowed=f"{-self._back / NS:+g} to {self._ahead / NS:+g} s",
            next_step="It was not used; check the sender's clock",
        )

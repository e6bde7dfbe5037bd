"""What a node knows about its own health: level, one line, counters and ages; published on /diagnostics."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE


class Diagnostics:
    """Counters and ages of one node; safe to write from callbacks and from a worker thread."""

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic):
        self._name = name
        self._clock = clock
        self._lock = threading.Lock()
        self._level: bytes = OK
        self._message = "starting"
        self._beside = ""  # a warning that holds whatever the status says
        self._counts: dict[str, int] = {}
        self._values: dict[str, str] = {}
        self._seen: dict[str, float] = {}  # [s] on `clock`

    def status(self, level: bytes, message: str) -> bool:
        """Set level and line. Returns True if they changed."""
        with self._lock:
            changed = (level, message) != (self._level, self._message)
            self._level, self._message = level, message
            return changed

    def beside(self, warning: str) -> bool:
        """Set a warning that is shown beside the status, '' for none. Returns True if it changed."""
        with self._lock:
            changed, self._beside = warning != self._beside, warning
            return changed

    @property
    def level(self) -> bytes:
        """The level in force."""
        return self._level

    @property
    def message(self) -> str:
        """The line in force."""
        return self._message

    def count(self, what: str, by: int = 1) -> int:
        """Add to a counter and return its value."""
        with self._lock:
            self._counts[what] = self._counts.get(what, 0) + by
            return self._counts[what]

    def counter(self, what: str) -> int:
        """A counter's value."""
        return self._counts.get(what, 0)

    def value(self, what: str, text: str) -> None:
        """Show a value."""
        with self._lock:
            self._values[what] = text

    def seen(self, what: str) -> None:
        """Note that a message of this topic arrived now."""
        with self._lock:
            self._seen[what] = self._clock()

    def age(self, what: str) -> float | None:
        """Time since the last message of a topic [s], None before the first."""
        with self._lock:
            return self._clock() - self._seen[what] if what in self._seen else None

    def message_at(self, stamp: Time) -> DiagnosticArray:
        """The message for /diagnostics."""
        with self._lock:
            now = self._clock()
            values = {
                **{f"count: {k}": str(v) for k, v in sorted(self._counts.items())},
                **{f"age of {k} [s]": f"{now - v:.3f}" for k, v in sorted(self._seen.items())},
                **self._values,
            }
            status = DiagnosticStatus(
                level=max(self._level, WARN) if self._beside else self._level,
                name=self._name,
                message="; ".join(line for line in (self._message, self._beside) if line),
                hardware_id="",
                values=[KeyValue(key=k, value=v) for k, v in values.items()],
            )
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp
        return array

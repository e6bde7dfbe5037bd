"""Commands that start nodes: whatever ends them, one line says it, and the nodes end with them."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any, NoReturn

from pred_core.cli.main import BAD_INPUT, INTERRUPTED
from pred_core.errors import PredError


def run_command(program: str, act: Callable[[], int]) -> int:
    """Exit code of `act`; 2 with one line on bad input or a node that failed; 130 where Ctrl-C or SIGTERM ended it."""
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        return act()
    except PredError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"{program}: interrupted; nothing is left running", file=sys.stderr)
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: object) -> NoReturn:
    """SIGTERM ends the nodes as Ctrl-C does."""
    raise KeyboardInterrupt


class Interrupts:
    """Within it, SIGINT and SIGTERM only leave a mark, for whoever spins to `check`.

    An exception that a signal raises inside the client library can come out as another one.
    """

    def __init__(self) -> None:
        self._asked: list[int] = []
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, lambda received, _: self._asked.append(received))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if kind is None:
            self.check()

    def check(self) -> None:
        """Raises: KeyboardInterrupt, once for all signals since the last call."""
        if self._asked:
            self._asked.clear()
            raise KeyboardInterrupt

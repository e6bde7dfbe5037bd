"""Commands that start nodes: whatever ends them, one line says it, and the nodes end with them."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from typing import NoReturn

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

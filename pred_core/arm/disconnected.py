"""Stands in for an arm whose connection was lost, until a person asks for it again."""

from __future__ import annotations

from typing import NoReturn

from pred_core.arm.protocol import SetPoint
from pred_core.errors import InputError


class DisconnectedArm:
    """Every call but `stop` and `close` raises InputError with the line of the loss."""

    def __init__(self, line: str):
        self._line = line

    def read(self) -> NoReturn:
        """Raises: InputError."""
        raise InputError(self._line)

    def begin(self) -> NoReturn:
        """Raises: InputError."""
        raise InputError(self._line)

    def command(self, setpoint: SetPoint) -> NoReturn:
        """Raises: InputError."""
        raise InputError(self._line)

    def stop(self) -> None:
        """Nothing to stop."""

    def close(self) -> None:
        """Nothing to close."""

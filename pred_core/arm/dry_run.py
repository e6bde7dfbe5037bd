"""An arm of air: it is where it was told to be. The default of the arm node."""

from __future__ import annotations

import numpy as np

from pred_core.arm.orientation import Quaternion
from pred_core.arm.protocol import Array, Reading, SetPoint
from pred_core.errors import InputError


class DryRunArm:
    """Follows every set-point exactly, after `begin`; starts at `position` (3,) [m] world and `rotation` wxyz."""

    def __init__(self, position: Array, rotation: Quaternion, closed: bool = True):
        self._position, self._rotation, self._closed = np.array(position, float), rotation, closed
        self._following = False

    def read(self) -> Reading:
        """Where it was told to be."""
        return Reading(self._position.copy(), self._rotation, True, "dry run", self._closed)

    def begin(self) -> None:
        """Follow from now on."""
        self._following = True

    def command(self, setpoint: SetPoint) -> None:
        """Be there. Raises: InputError before `begin`."""
        if not self._following:
            raise InputError("dry run: a set-point before the arm was enabled")
        self._position, self._rotation = setpoint.position.copy(), setpoint.rotation

    def stop(self) -> None:
        """Follow nothing."""
        self._following = False

    def close(self) -> None:
        """Stop."""
        self.stop()

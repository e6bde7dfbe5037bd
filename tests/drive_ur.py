"""Drives the real ur_rtde receive interface, as a process: `python drive_ur.py HOST`; one JSON line a reading.

Reads when a line comes on standard input. The control interface is not started: it needs a controller that runs
scripts; `UrArm` gets one that refuses to do anything.
"""

from __future__ import annotations

import json
import os
import sys

import numpy as np
from rtde_receive import RTDEReceiveInterface

from pred_core.arm.orientation import UP
from pred_core.arm.placement import Placement
from pred_core.arm.step_check import StepCheck
from pred_core.arm.ur import UrArm
from pred_core.errors import InputError


class NoControl:
    """A control interface that must not be used."""

    def __getattr__(self, name: str) -> object:
        raise AttributeError(f"the control interface was asked for '{name}'")


def main(host: str) -> None:
    """One reading and one try to begin for each line."""
    arm = UrArm(NoControl(), RTDEReceiveInterface(host), Placement(np.zeros(3), UP), 0.008, StepCheck(0.008, 1.0, 1.0))  # type: ignore[arg-type]
    for _ in sys.stdin:
        try:
            reading = arm.read()
            found = {
                "position": reading.position.tolist(),
                "rotation": list(reading.rotation),
                "ready": reading.ready,
                "message": reading.message,
                "joints": reading.joints,
            }
            if not reading.ready:
                try:
                    arm.begin()
                except InputError as error:
                    found["begin"] = str(error)
        except InputError as error:
            found = {"error": str(error)}
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
    sys.stdout.flush()
    os._exit(0)

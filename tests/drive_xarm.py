"""Drives the real xArm SDK through its adapter, as a process: `python drive_xarm.py HOST`.

Lines on standard input: `begin`, `read`, `move N` (N set-points at 50 Hz, 0.1 m/s along world x), `stop`. Each is
answered with one JSON line.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

import numpy as np
from fake_xarm import CONTROL_PORT
from xarm.core.config.x_config import XCONF

from pred_core.arm.limits import GuardConfig, bounds_of
from pred_core.arm.orientation import UP
from pred_core.arm.placement import Placement
from pred_core.arm.protocol import SetPoint
from pred_core.arm.xarm import XArm, connect_xarm
from pred_core.errors import InputError

PERIOD, SPEED = 0.02, 0.1  # [s], [m/s]


def move(arm: XArm, count: int) -> None:
    """A straight line from here, in real time."""
    start, begun = arm.read(), time.monotonic()
    for k in range(1, count + 1):
        arm.read()  # as the node does before each set-point
        place = start.position + (SPEED * (time.monotonic() - begun), 0.0, 0.0)
        arm.command(SetPoint(place, start.rotation, np.array([SPEED, 0.0, 0.0]), np.zeros(3)))
        time.sleep(max(0.0, begun + k * PERIOD - time.monotonic()))


def obey(arm: XArm, word: str, rest: list[str]) -> dict[str, Any]:
    """One line."""
    try:
        if word == "begin":
            arm.begin()
        elif word == "move":
            move(arm, int(rest[0]))
        elif word == "stop":
            arm.stop()
        found = arm.read()
    except InputError as error:
        return {"error": str(error)}
    return {"position": found.position.tolist(), "ready": found.ready, "message": found.message}


def main(host: str) -> None:
    """Until standard input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the SDK prints from its threads
    XCONF.SocketConf.TCP_CONTROL_PORT = CONTROL_PORT
    config = GuardConfig()
    arm = connect_xarm(
        host, Placement(np.zeros(3), UP), bounds_of(config), config.speed, config.angular_speed, CONTROL_PORT
    )
    for line in sys.stdin:
        word, *rest = line.split()
        print(json.dumps(obey(arm, word, rest)), file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
    sys.stdout.flush()
    os._exit(0)

"""The stand-in arm of the plant node, reached over TCP like any controller: one line of JSON a request."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pred_core.arm.protocol import Reading, SetPoint
from pred_core.errors import InputError

HOST, PORT = "127.0.0.1", 7654
PATIENCE = 2.0  # [s] for a reply
STARTING = 30.0  # [s] to connect: a plant that is started together with the arm is not there yet
START_IT = "Start the plant node with the same port; then reset the arm, which connects again"


class PlantArm:
    """An arm in the plant's controller. Works in world; the controller stops by itself 0.1 s after a set-point."""

    def __init__(self, connection: socket.socket):
        self._connection, self._replies = connection, connection.makefile("rb")

    def read(self) -> Reading:
        """Measured pose, joints, jaws. Raises: InputError without connection or answer."""
        reply = self._ask({"do": "read"})
        position, rotation = np.array(reply["position"], float), [float(v) for v in reply["rotation"]]
        if position.shape != (3,) or len(rotation) != 4 or not np.isfinite([*position.tolist(), *rotation]).all():
            raise InputError("plant: the controller reports no pose", got=f"{reply['position']} {reply['rotation']}")
        joints = {str(k): float(v) for k, v in reply["joints"].items()}
        turned = (rotation[0], rotation[1], rotation[2], rotation[3])
        ready, message, closed = bool(reply["ready"]), str(reply["message"]), bool(reply["closed"])
        return Reading(position, turned, ready, message, closed, joints, int(reply["stamp"]))

    def begin(self) -> None:
        """Take set-points from now on. Raises: InputError after a fault, which only the plant's ~/clear ends."""
        self._ask({"do": "begin"})

    def command(self, setpoint: SetPoint) -> None:
        """Follow this set-point. Raises: InputError before `begin` and after a fault."""
        self._ask(
            {
                "do": "command",
                "position": setpoint.position.tolist(),
                "rotation": list(setpoint.rotation),
                "velocity": setpoint.velocity.tolist(),
                "angular_velocity": setpoint.angular_velocity.tolist(),
            }
        )

    def stop(self) -> None:
        """Come to rest, follow nothing."""
        self._ask({"do": "stop"})

    def close(self) -> None:
        """Hang up; the controller stops the arm then."""
        self._replies.close()
        self._connection.close()

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        try:
            self._connection.sendall(json.dumps(request).encode() + b"\n")
            line = self._replies.readline()
        except OSError as error:
            self.close()  # a reply that comes late would be taken for that of the next request
            raise InputError("plant: connection lost", got=error, next_step=START_IT) from error
        if not line:
            raise InputError("plant: the controller hung up", next_step=START_IT)
        try:
            reply = json.loads(line)
            good, reason = bool(reply["ok"]), str(reply.get("error", ""))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError("plant: not the plant's protocol", got=repr(line[:60]), next_step=START_IT) from error
        if not good:
            raise InputError(reason)
        return dict(reply)


def connect_plant(
    host: str = HOST, port: int = PORT, patience: float = STARTING, sleep: Callable[[float], None] = time.sleep
) -> PlantArm:
    """Connect to a plant node that knows within `patience` [s] where its arm is; `sleep` may end the waiting by an
    exception.

    Raises: InputError if nobody answers, or the plant has not begun by then.
    """
    end = time.monotonic() + patience
    while True:
        try:
            connection = socket.create_connection((host, port), timeout=PATIENCE)
        except OSError as error:
            if time.monotonic() > end:
                raise InputError(f"plant: nobody at {host}:{port}", got=error, next_step=START_IT) from error
        else:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            arm = PlantArm(connection)
            try:
                arm.read()
                return arm
            except InputError:
                arm.close()
                if time.monotonic() > end:
                    raise
        sleep(0.1)

"""The arm's controller on the network, as real ones are: one line of JSON a request, one a reply.

Requests: {"do": "read" | "begin" | "stop"} and {"do": "command", "position": [m], "rotation": wxyz, "velocity":
[m/s], "angular_velocity": [rad/s]}, all in world. Replies: {"ok": true, ...} or {"ok": false, "error": "one line"}.
"""

from __future__ import annotations

import contextlib
import json
import socketserver
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pred_core.errors import ConfigError, InputError
from pred_core.plant.live.cell import Truth
from pred_core.plant.live.mover import ToolPose
from pred_core.plant.live.servo import Servo

PORT = 7654  # unless told otherwise
LONGEST_LINE = 4096  # [bytes]


class Controller:
    """Serves one arm on a TCP port of this machine."""

    def __init__(self, servo: Servo, truth: Callable[[], Truth], clock: Callable[[], float], port: int):
        """truth: what is measured now, may raise InputError; clock: time of the cell [s]; port 0: any free one.

        Raises: ConfigError if the port is taken.
        """
        self._servo, self._truth, self._clock = servo, truth, clock
        try:
            self._server = _Server(("127.0.0.1", port), _handler(self))
        except OSError as error:
            raise ConfigError(f"port {port} cannot be opened", got=error, next_step="Use another port") from error
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), name="controller", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hang up."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def hang_up(self) -> None:
        """The other end is gone: follow nothing."""
        self._servo.stop()

    def answer(self, line: bytes) -> dict[str, Any]:
        """The reply to one request."""
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise InputError("plant: a request that is not a mapping")
            return {"ok": True, **self._do(request)}
        except (KeyError, TypeError, ValueError) as error:  # PredError and JSON's own are ValueErrors
            return {"ok": False, "error": str(error) or repr(error)}

    def _do(self, request: Mapping[str, Any]) -> dict[str, Any]:
        match request.get("do"):
            case "read":
                return self._read()
            case "begin":
                self._servo.begin()
            case "stop":
                self._servo.stop()
            case "command":
                pose = ToolPose(np.array(request["position"], float), np.array(request["rotation"], float))
                turn = np.array(request["angular_velocity"], float)
                self._servo.command(pose, np.array(request["velocity"], float), turn, self._clock())
            case other:
                raise InputError("plant: unknown request", got=repr(other), allowed="read, begin, command, stop")
        return {}

    def _read(self) -> dict[str, Any]:
        truth = self._truth()
        return {
            "position": truth.gripper.position.tolist(),
            "rotation": truth.gripper.rotation.tolist(),
            "closed": truth.closed,
            "joints": truth.joints,
            "stamp": truth.stamp,
            "ready": not self._servo.fault,
            "message": self._servo.fault or ("following" if self._servo.following else "idle"),
        }


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True


def _handler(controller: Controller) -> type[socketserver.StreamRequestHandler]:
    class Handler(socketserver.StreamRequestHandler):
        disable_nagle_algorithm = True

        def handle(self) -> None:
            with contextlib.suppress(ConnectionError):
                while line := self.rfile.readline(LONGEST_LINE):
                    self.wfile.write(json.dumps(controller.answer(line)).encode() + b"\n")
            controller.hang_up()  # whoever commanded is gone

    return Handler

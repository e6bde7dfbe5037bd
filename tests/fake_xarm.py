"""An xArm controller that speaks its TCP protocol, as a process: `python fake_xarm.py HOST`.

Private Modbus TCP: transaction, protocol, length (u16 each), register (u8); an answer adds a state byte before its
data. The tool moves with the velocity it was given until that velocity's duration is over. A line `show` on standard
input prints what the controller knows as JSON, `error N` puts it into an error.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import sys
import threading
import time
from typing import Any

CONTROL_PORT, REPORT_PORT = 15502, 30002  # a real controller has 502, which needs privileges
VERSION = b"7,7,XI130000000000,AC1300000000,v2.3.0"
GET_VERSION, GET_SERIAL, MOTION_ENABLE, SET_STATE, GET_STATE, GET_ERROR, CLEAN_ERROR, SET_MODE = (
    1,
    2,
    11,
    12,
    13,
    15,
    16,
    19,
)
GET_POSE, GET_JOINTS, SET_BOUNDARY, SET_FENCE, SET_VELOCITY = 41, 42, 52, 59, 82
ERROR_BIT, NOT_READY_BIT = 0x40, 0x10
REPORT_SIZE = 245  # of the rich report


class Controller:
    """Pose [mm, rad], and what it was told."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.pose = [300.0, 0.0, 250.0, math.pi, 0.0, 0.0]
        self.speeds, self.until, self.time = [0.0] * 6, 0.0, time.monotonic()
        self.known: dict[str, Any] = {"state": 4, "mode": 0, "error": 0, "enabled": 0, "cleaned": 0, "velocities": 0}

    def move(self) -> None:
        """Up to now, no longer than the dead-man allows."""
        now = time.monotonic()
        seconds = max(0.0, min(now, self.until) - self.time)
        self.pose = [p + v * seconds for p, v in zip(self.pose, self.speeds, strict=True)]
        self.time = now

    def answer(self, register: int, data: bytes) -> bytes:
        """State byte and data for one request."""
        with self.lock:
            self.move()
            found = self._handle(register, data)
            state = ERROR_BIT if self.known["error"] else 0
            if self.known["state"] >= 4:
                state |= NOT_READY_BIT
            return bytes([state]) + found

    def _handle(self, register: int, data: bytes) -> bytes:
        known = self.known
        if register == GET_VERSION:
            return VERSION.ljust(40, b"\0")
        if register == GET_SERIAL:
            return b"XI130000000000\0AC1300000000".ljust(40, b"\0")
        if register == GET_STATE:
            return bytes([known["state"]])
        if register == GET_ERROR:
            return bytes([known["error"], 0])
        if register == GET_POSE:
            return struct.pack("<6f", *self.pose)
        if register == GET_JOINTS:
            return struct.pack("<7f", *[0.1] * 7)
        if register == SET_STATE:  # 0: ready, reported as 2 (standby); 4: stopped
            known["state"] = 2 if data[0] == 0 else data[0]
        elif register == SET_MODE:
            known["mode"] = data[0]
        elif register == MOTION_ENABLE:
            known["enabled"] = data[1]
        elif register == CLEAN_ERROR:
            known["cleaned"] += 1
        elif register == SET_BOUNDARY:
            known["boundary"] = list(struct.unpack("<6i", data))
        elif register == SET_FENCE:
            known["fence"] = data[0]
        elif register == SET_VELOCITY:
            *speeds, coordinates, duration = struct.unpack("<6fBf", data)
            known.update(coordinates=coordinates, duration=duration, velocities=known["velocities"] + 1)
            if known["mode"] == 5 and known["state"] < 4 and not known["error"]:
                self.speeds, self.until = speeds, time.monotonic() + duration
        return b""

    def report(self) -> bytes:
        """One report of the rich kind: the fields the driver's own code reads first; the rest zero."""
        with self.lock:
            self.move()
            head = struct.pack(">IBH", REPORT_SIZE, self.known["mode"] << 4 | self.known["state"], 0)
            values = struct.pack("<7f6f7f", *[0.1] * 7, *self.pose, *[0.0] * 7)
            motors = bytes([0x7F, 0x7F if self.known["enabled"] else 0, self.known["error"], 0])
            offsets = struct.pack("<6f4f", *[0.0] * 10) + bytes([3, 3]) + struct.pack("<3f", 0.0, 0.0, -1.0)
        return (head + values + motors + offsets + bytes([7, 7])).ljust(REPORT_SIZE, b"\0")

    def show(self) -> str:
        """Everything as one line."""
        with self.lock:
            self.move()
            return json.dumps({**self.known, "pose": self.pose, "speeds": self.speeds})


def exactly(connection: socket.socket, count: int) -> bytes:
    """So many bytes, b'' at the end."""
    data = b""
    while len(data) < count:
        more = connection.recv(count - len(data))
        if not more:
            return b""
        data += more
    return data


def serve(connection: socket.socket, controller: Controller) -> None:
    """Requests of one client. A heartbeat (register 0) is not answered."""
    with connection:
        while head := exactly(connection, 6):
            transaction, protocol, length = struct.unpack(">HHH", head)
            body = exactly(connection, length)
            if not body or body[0] == 0:
                continue
            answer = controller.answer(body[0], body[1:])
            connection.sendall(struct.pack(">HHH", transaction, protocol, 1 + len(answer)) + body[:1] + answer)


def send_reports(connection: socket.socket, controller: Controller) -> None:
    """20 reports a second until the client is gone."""
    with connection:
        while True:
            try:
                connection.sendall(controller.report())
            except OSError:
                return
            time.sleep(0.05)


def accept(server: socket.socket, handler: Any, controller: Controller) -> None:
    """A thread for each client."""
    while True:
        connection, _ = server.accept()
        threading.Thread(target=handler, args=(connection, controller), daemon=True).start()


def main(host: str) -> None:
    """Serve until standard input ends."""
    controller = Controller()
    for port, handler in ((CONTROL_PORT, serve), (REPORT_PORT, send_reports)):
        server = socket.create_server((host, port))
        threading.Thread(target=accept, args=(server, handler, controller), daemon=True).start()
    print("listening", flush=True)
    for line in sys.stdin:
        word, *rest = line.split()
        if word == "show":
            print(controller.show(), flush=True)
        elif word == "error":
            with controller.lock:
                controller.known["error"] = int(rest[0])


if __name__ == "__main__":
    main(sys.argv[1])

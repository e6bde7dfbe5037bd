"""A UR controller that speaks RTDE on port 30004, as a process: `python fake_rtde.py HOST`.

Written from the published protocol (version 2). It reports one pose and joints; a line `protective`, `emergency`,
`mode N` or `end` on its standard input changes what it reports.
"""

from __future__ import annotations

import re
import socket
import struct
import sys
import threading

PORT = 30004
POSE = (0.0, -0.3, 0.25, 2.0, -1.0, 0.5)  # [m], [rad] in the base
JOINTS = (0.1, -1.2, 1.3, -0.4, 0.5, 0.6)  # [rad]
SIZES = {"VECTOR6D": ">6d", "VECTOR3D": ">3d", "VECTOR6INT32": ">6i", "DOUBLE": ">d", "UINT64": ">Q", "UINT32": ">I",
         "INT32": ">i", "UINT8": ">B"}  # fmt: skip
# Types of the output variables (RTDE guide, table of robot controller outputs), by name.
TYPES = (
    (r"timestamp|actual_execution_time|speed_scaling|target_speed_fraction|actual_momentum|payload", "DOUBLE"),
    (
        r"actual_(main|robot)_(voltage|current)|standard_analog_.*|tool_analog_.*|io_current|tool_output_current",
        "DOUBLE",
    ),
    (r"output_double_register_\d+|tcp_force_scalar|tool_temperature", "DOUBLE"),
    (r"actual_digital_(in|out)put_bits", "UINT64"),
    (r"runtime_state|robot_status_bits|safety_status_bits|output_bit_registers.*", "UINT32"),
    (r"robot_mode|safety_mode|safety_status|output_int_register_\d+|tool_mode", "INT32"),
    (r"joint_mode", "VECTOR6INT32"),
    (r"actual_tool_accelerometer|elbow_.*|payload_cog", "VECTOR3D"),
    (r".*", "VECTOR6D"),
)
NORMAL, PROTECTIVE, EMERGENCY = 1 << 0, 1 << 2, 1 << 7  # safety_status_bits


class Controller:
    """What the controller reports."""

    def __init__(self) -> None:
        self.safety, self.mode, self.time = NORMAL, 7, 0.0
        self.over = threading.Event()

    def value(self, name: str, kind: str) -> bytes:
        """One output variable."""
        known = {
            "actual_TCP_pose": POSE,
            "actual_q": JOINTS,
            "robot_mode": (self.mode,),
            "safety_status_bits": (self.safety,),
            "timestamp": (self.time,),
        }
        count = int(SIZES[kind][1]) if len(SIZES[kind]) == 3 else 1
        return struct.pack(SIZES[kind], *known.get(name, (0,) * count))

    def obey(self) -> None:
        """Lines from standard input."""
        for line in sys.stdin:
            word, *rest = line.split()
            if word == "protective":
                self.safety |= PROTECTIVE
            elif word == "emergency":
                self.safety |= EMERGENCY
            elif word == "mode":
                self.mode = int(rest[0])
            elif word == "end":
                break
        self.over.set()


def packet(kind: int, payload: bytes) -> bytes:
    """Size, type, payload."""
    return struct.pack(">HB", 3 + len(payload), kind) + payload


def type_of(name: str) -> str:
    """The type of an output variable."""
    return next(kind for pattern, kind in TYPES if re.fullmatch(pattern, name))


def serve(connection: socket.socket, controller: Controller) -> None:
    """One client: handshake, recipe, then 125 packages a second."""
    names: list[str] = []
    running = False
    connection.settimeout(0.008)
    received = b""
    while not controller.over.is_set():
        try:
            more = connection.recv(65536)
            if not more:
                return
            received += more
        except TimeoutError:
            pass
        while len(received) >= 3 and len(received) >= struct.unpack(">H", received[:2])[0]:
            size, kind = struct.unpack(">HB", received[:3])
            payload, received = received[3:size], received[size:]
            if kind == ord("V"):
                answer = struct.pack(">B", struct.unpack(">H", payload)[0] == 2)
            elif kind == ord("v"):
                answer = struct.pack(">4I", 5, 12, 0, 0)
            elif kind == ord("O"):
                names = payload[8:].decode().split(",")
                answer = b"\x01" + ",".join(map(type_of, names)).encode()
            elif kind in (ord("S"), ord("P")):
                running, answer = kind == ord("S"), b"\x01"
            else:
                raise SystemExit(f"fake_rtde: a package of type {kind} was not expected")
            connection.sendall(packet(kind, answer))
        if running:
            controller.time += 0.008
            values = b"".join(controller.value(name, type_of(name)) for name in names)
            connection.sendall(packet(ord("U"), b"\x01" + values))


def main(host: str) -> None:
    """Serve until standard input ends."""
    controller = Controller()
    threading.Thread(target=controller.obey, daemon=True).start()
    with socket.create_server((host, PORT)) as server:
        print("listening", flush=True)
        server.settimeout(0.1)
        while not controller.over.is_set():
            try:
                connection, _ = server.accept()
            except TimeoutError:
                continue
            with connection:
                serve(connection, controller)


if __name__ == "__main__":
    main(sys.argv[1])

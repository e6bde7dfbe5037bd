"""Child processes for nodes: own domain, quick end, nothing left behind."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from pred_core.errors import ConfigError, nearest
from pred_ros import shared_memory
from pred_ros.dead_ports import unicast_port

# A node started with this variable ends when its parent is gone, however that ended.
END_WITH_PARENT = "PRED_END_WITH_PARENT"
NODES = ("player", "plant", "tracker", "predictor", "evaluator", "planner", "arm")
POLITE = 4.0  # [s] between SIGINT and SIGKILL

_draws = itertools.count()

# The ROS wheels re-execute the interpreter once to set LD_LIBRARY_PATH and mark it done with this variable;
# a child in another environment must do it again.
_BOOTSTRAP_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def node_environment(domain: int | None = None) -> dict[str, str]:
    """Environment of a node, on Fast DDS; with `domain`, on this machine only."""
    environment = {k: v for k, v in os.environ.items() if k != _BOOTSTRAP_GUARD}
    environment.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    environment["PYTHONUNBUFFERED"] = "1"
    environment[END_WITH_PARENT] = "1"
    if domain is not None:
        environment["ROS_DOMAIN_ID"] = str(domain)
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    return environment


def free_domain() -> int:
    """A ROS domain, 1 to 100, in which nobody on this machine has opened a participant yet.

    The search begins at a place drawn from the process id, so that runs started together differ.
    Raises: ConfigError if all are taken.
    """
    for k in range(100):
        domain = 1 + (os.getpid() * 13 + next(_draws) + k) % 100
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", unicast_port(domain, 0)))
            except OSError:
                continue
            return domain
    raise ConfigError("no free ROS domain on this machine", allowed="1 to 100")


def node_command(node: str, parameters: Mapping[str, object]) -> list[str]:
    """Command line that starts a node of this package with parameters.

    Raises: ConfigError for a node that does not exist.
    """
    if node not in NODES:
        raise ConfigError(f"unknown node '{node}'", next_step=nearest(node, NODES))
    arguments = [sys.executable, "-m", f"pred_ros.{node}_node"]
    if parameters:
        arguments.append("--ros-args")
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={_yaml_scalar(value)}"]
    return arguments


def _yaml_scalar(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    quoted = str(value).replace("'", "''")
    return f"'{quoted}'"


@dataclass
class Children:
    """A group of processes; leaving the context ends every one of them, with force if need be."""

    environment: Mapping[str, str]
    logs: Path
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    polite: float = POLITE  # [s]

    def __enter__(self) -> Children:
        self.logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def start(self, name: str, command: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start a process in a session of its own; its output goes to `logs`/NAME.log."""
        with (self.logs / f"{name}.log").open("wb") as log:
            self.running[name] = subprocess.Popen(
                list(command), stdout=log, stderr=subprocess.STDOUT, env=dict(self.environment), start_new_session=True
            )
        return self.running[name]

    def log(self, name: str) -> str:
        """What a process has printed so far."""
        return (self.logs / f"{name}.log").read_text(encoding="utf-8", errors="replace")

    def last_line(self, name: str) -> str:
        """The last line a process printed, '' if none."""
        lines = [line for line in self.log(name).splitlines() if line.strip()]
        return lines[-1] if lines else ""

    def end(self) -> None:
        """SIGINT to all, then SIGKILL to what stays of their process groups; sweep the shared memory of the killed."""
        for process in self.running.values():
            _signal_group(process, signal.SIGINT)
        deadline = time.monotonic() + self.polite
        for process in self.running.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))
            _signal_group(process, signal.SIGKILL)
            process.wait()
        shared_memory.sweep()


def _signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):  # all of it ended in the meantime
        os.killpg(process.pid, number)

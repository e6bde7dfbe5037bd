"""Ports of shared memory that a killed node has left, and to which others still write.

A new participant takes the lowest free number, and with it the ports of the one that was killed. Fast DDS makes their
shared memory anew, the others go on writing to the old one, and the new node hears nothing until they have given up the
dead one, for up to 20 s (github.com/eProsima/Fast-DDS, issue 5469). So these ports are kept taken while a node begins.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

PORT = re.compile(r"/fastrtps_port(\d+)\b")
PROCESSES = Path("/proc")


@contextmanager
def avoided() -> Iterator[None]:
    """Within it no participant gets the ports of a dead one: its UDP ports have the same numbers, and are taken."""
    with ExitStack() as held:
        for port in sorted(written_ports()):
            for number in (port - 1, port):  # of discovery, of data
                taken = held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                try:
                    taken.bind(("", number))
                except OSError:  # its participant lives
                    taken.close()
        yield


def unicast_port(domain: int, number: int) -> int:
    """Discovery port of a participant, DDS-RTPS 9.6.2.3; the one above it is for data."""
    return 7400 + 250 * domain + 10 + 2 * number


def written_ports() -> set[int]:
    """Shared-memory ports that some process has open; empty where the system does not tell."""
    found: set[int] = set()
    for maps in PROCESSES.glob("[0-9]*/maps"):
        try:
            found.update(int(port) for port in PORT.findall(maps.read_text(encoding="utf-8", errors="replace")))
        except OSError:  # it has ended, or is another user's
            continue
    return found

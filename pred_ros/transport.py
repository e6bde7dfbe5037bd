"""How a node's messages travel: pictures through shared memory, everything else through UDP.

Shared memory is fast, but not safe from a killed process (Fast DDS 2.14; github.com/eProsima/Fast-DDS, issues 5469 and
4728): one that is killed while it holds the lock of a port stops every process that writes to that port. So only nodes
that carry pictures use it, and nothing that happens to them can hold up the arm.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from pred_ros.resources import config_folder

PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
CHOICE = (PROFILES, "FASTDDS_DEFAULT_PROFILES_FILE", TRANSPORTS, "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY")


def variables(pictures: bool, environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """What a process must add to its environment before its first node; {} where the user has chosen already.

    Raises: ConfigError if the installation is incomplete.
    """
    if any(environment.get(name) for name in CHOICE):
        return {}
    if pictures:
        return {PROFILES: str(config_folder() / "fastdds.xml")}
    if environment.get(RANGE, "").upper() == "LOCALHOST":  # there the client library adds shared memory
        return {PROFILES: str(config_folder() / "fastdds_local.xml"), RANGE: "SYSTEM_DEFAULT"}
    return {TRANSPORTS: "UDPv4"}


@contextmanager
def added(wanted: Mapping[str, str]) -> Iterator[None]:
    """These variables for this process, for a while: they are read where its first node begins."""
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value

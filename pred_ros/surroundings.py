"""What a node notices of the others: a second publisher of what it publishes, simulated time that stands still."""

from __future__ import annotations

import time
from typing import Any

from rclpy.node import Node

SHARED = ("/diagnostics", "/joint_states", "/parameter_events", "/rosout")  # topics meant for many publishers
RIVAL = 30.0  # [s] a second publisher is named after: discovery remembers a killed node for 20 s
STILL = 5.0  # [s] of the wall without simulated time


class Surroundings:
    """Ask it about once a second; all times are of the wall."""

    def __init__(self, node: Node):
        self._node = node
        self._doubled: dict[str, float] = {}  # topic -> [s] since when it has had more than one publisher
        self._clock = (-1, 0.0)  # simulated time [ns], and [s] when it was first seen

    def trouble(self) -> str:
        """What a person should know, or ''."""
        now = time.monotonic()
        return "; ".join(line for line in (self._still(now), self._rivals(now)) if line)

    def _still(self, now: float) -> str:
        clock: Any = self._node.get_clock()
        if not clock.ros_time_is_active:
            return ""
        simulated = clock.now().nanoseconds
        if simulated != self._clock[0]:
            self._clock = simulated, now
        if now - self._clock[1] < STILL:
            return ""
        return "use_sim_time is set, but /clock stands still: its sender has ended, waits, or is not there yet"

    def _rivals(self, now: float) -> str:
        own = {publisher.topic_name for publisher in self._node.publishers} - set(SHARED)
        found = {topic: self._node.get_publishers_info_by_topic(topic) for topic in sorted(own)}
        self._doubled = {t: self._doubled.get(t, now) for t, publishers in found.items() if len(publishers) > 1}
        lasting = [topic for topic, since in self._doubled.items() if now - since >= RIVAL]
        if not lasting:
            return ""
        names = sorted(f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in found[lasting[0]])
        return f"{lasting[0]} has {len(names)} publishers: {', '.join(names)}; stop all but one"

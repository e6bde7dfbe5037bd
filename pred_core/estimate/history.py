"""States and grips of the last moments: a track that comes late corrects the state of its own time."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from pred_core.types import Array, Grip, State

NS = 1e9
SAME = 200_000  # [ns] a stamp this close to a node's is the node's


@dataclass(frozen=True)
class Node:
    """The state at the end of a period, and the gripper then."""

    stamp: int  # [ns]
    state: State
    grip: Grip


class History:
    """Nodes in order of time, the newest last; older ones than `length` [s] before it are forgotten."""

    def __init__(self, length: float):
        self._length = round(length * NS)
        self._nodes: list[Node] = []

    def __len__(self) -> int:
        return len(self._nodes)

    @property
    def newest(self) -> Node:
        """The last node."""
        return self._nodes[-1]

    @property
    def oldest(self) -> Node:
        """The first one that is kept."""
        return self._nodes[0]

    def add(self, node: Node) -> None:
        """A node later than all others."""
        self._nodes.append(node)
        while self._nodes[0].stamp < node.stamp - self._length:
            self._nodes.pop(0)

    def before(self, stamp: int) -> int:
        """Index of the last node at or before `stamp` [ns], which is not older than the oldest."""
        return bisect_right(self._nodes, stamp + SAME, key=lambda n: n.stamp) - 1

    def node(self, index: int) -> Node:
        """One of them."""
        return self._nodes[index]

    def cut(self, index: int) -> list[Node]:
        """Take away the nodes from `index` on, and return them."""
        tail, self._nodes = self._nodes[index:], self._nodes[:index]
        return tail

    def position_at(self, index: int, stamp: int) -> Array:
        """(N, 3) [m] at `stamp`, from node `index` to the next along a cubic with the velocities of both."""
        a = self._nodes[index]
        begin = a.state.position.double().numpy()
        if abs(stamp - a.stamp) <= SAME:
            return begin
        velocity = a.state.velocity.double().numpy()
        if index + 1 == len(self._nodes):
            return begin + velocity * ((stamp - a.stamp) / NS)
        b = self._nodes[index + 1]
        span = (b.stamp - a.stamp) / NS
        t = (stamp - a.stamp) / (b.stamp - a.stamp)
        end, after = b.state.position.double().numpy(), b.state.velocity.double().numpy()
        h = np.array([2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, 3 * t**2 - 2 * t**3, t**3 - t**2])
        return np.asarray(h[0] * begin + h[1] * span * velocity + h[2] * end + h[3] * span * after)

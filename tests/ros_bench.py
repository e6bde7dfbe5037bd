"""A small world for node tests: one predictor or evaluator in this process, publishers that feed it, diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray
from live_world import CLOSED, points, pose
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray

from pred_core.types import State
from pred_ros import convert, qos, transport
from pred_ros.processes import free_domain
from pred_ros.shell import Shell


class Bench:
    """One node under test and what surrounds it, spun together."""

    def __init__(self, node: Shell):
        self.node = node
        self.world = rclpy.create_node("bench")
        complete = qos.points_complete()
        self.points_out = self.world.create_publisher(PointCloud2, "tracker/points", complete)
        self.pose_out = self.world.create_publisher(PoseArray, "gripper/pose", complete)
        self.closed_out = self.world.create_publisher(UInt8MultiArray, "gripper/closed", complete)
        self.prediction_out = self.world.create_publisher(PointCloud2, "prediction/points", complete)
        self.predictions: list[tuple[int, State]] = []
        self.statuses: list[DiagnosticStatus] = []
        if node.get_name() == "predictor":
            self.world.create_subscription(PointCloud2, "prediction/points", self._on_prediction, complete)
        self.world.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(node)
        self.executor.add_node(self.world)

    def feed(self, frame: int) -> None:
        """Points, pose and flags of one frame."""
        self.closed_out.publish(convert.closed_to_message(CLOSED))
        self.pose_out.publish(convert.pose_to_message(pose(frame)))
        self.points_out.publish(convert.points_to_cloud(points(frame)))

    def until(self, condition: Callable[[], Any], what: str, limit: float = 60.0) -> None:
        """Spin until the condition holds; fail after `limit` [s]."""
        end = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < end, f"not within {limit} s: {what}; node says {self.node.diagnostics.message}"
            self.executor.spin_once(timeout_sec=0.01)

    def says(self, level: bytes, *words: str) -> bool:
        """True once /diagnostics carried this level with all of the words."""
        return any(s.level == level and all(w in s.message for w in words) for s in self.statuses)

    def _on_prediction(self, message: PointCloud2) -> None:
        stamp, _, state = convert.cloud_to_state(message, "prediction/points")
        self.predictions.append((stamp, state))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.statuses += [s for s in message.status if s.name.endswith(self.node.get_name())]


@contextmanager
def own_domain() -> Iterator[None]:
    """A ROS domain of this test, on this machine only."""
    with transport.added({"ROS_DOMAIN_ID": str(free_domain()), transport.RANGE: "LOCALHOST"}):
        yield


@contextmanager
def bench_of(node_class: type[Shell], parameters: dict[str, str], feeds: bool = True) -> Iterator[Bench]:
    """A node of a class, configured and active, in a domain of its own; `feeds`: wait until it listens."""
    arguments = ["--ros-args"]
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={value}"]
    with own_domain():
        rclpy.init(args=arguments)
        node = None
        try:
            node = node_class()
            bench = Bench(node)
            node.trigger_configure()
            node.trigger_activate()
            if feeds:
                bench.until(lambda: bench.points_out.get_subscription_count() >= 1, "the node listens")
            yield bench
        finally:
            if node is not None:
                node.stop()
                bench.executor.shutdown()
                node.destroy_node()
            rclpy.try_shutdown()

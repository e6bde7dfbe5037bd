"""Latency of the predictor node: from a published gripper pose to the received prediction.

    python benchmarks/predictor.py [--seconds 10]

Two cases of the design: a cable at 100 Hz, and 1,000 particles at 30 Hz. The node is a process of its own; both
processes use one thread. Prints p50, p99, the share of predictions that came before the next pose, and what was lost.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import rclpy
import torch
from geometry_msgs.msg import PoseArray
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray

from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, PREDICTION_POINTS, TRACKER_POINTS, stamp_of
from pred_core.springmass.simulator import SpringMass
from pred_core.springmass.topology import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Array, Physics, Scene
from pred_ros import convert, qos
from pred_ros.processes import Children, free_domain, node_command, node_environment

BEGIN = 1_000_000_000  # [ns]


@dataclass(frozen=True)
class Case:
    """One object at one rate."""

    name: str
    kind: str
    rest: Array  # (N, 3) [m]
    rate: float  # [Hz]
    spacing: float  # [m]
    stiffness: float  # [N]


def cases() -> list[Case]:
    """A cable of 13 particles and a sheet of 1,000."""
    cable = np.zeros((13, 3))
    cable[:, 0] = 0.08 * np.arange(13)
    i, j = np.divmod(np.arange(1000), 40)
    sheet = np.stack([0.01 * i, 0.01 * j, np.zeros(1000)], axis=-1)
    return [
        Case("cable, 13 particles", "line", cable, 100.0, 0.08, 50.0),
        Case("sheet, 1000 particles", "sheet", sheet, 30.0, 0.01, 2.0),
    ]


def measure(case: Case, seconds: float, folder: Path) -> tuple[Array, int, str]:
    """Latencies [s] of the predictions received, the number of poses sent, and the size of the simulation."""
    physics = Physics(stiffness=case.stiffness, damping=0.02, connection_threshold=1.5 * case.spacing, max_springs=8)
    body = build_body(case.kind, case.rest, 0.05, physics)
    twin = Twin(TwinMeta(period=1 / case.rate), body, physics, Scene())
    twin.save(folder / "twin")
    substeps = SpringMass(body, physics, twin.scene, period=twin.meta.period).substeps
    size = f"{len(body.springs)} springs, {substeps} substeps a period"
    domain = free_domain()
    os.environ.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    rclpy.init()
    sent: dict[int, float] = {}
    latency: list[float] = []
    try:
        with Children(node_environment(domain), folder / "log") as children:
            parameters = {"twin": folder / "twin", "held": "0:0", "wait_for": 1, "max_gap": 1.0}
            children.start("predictor", node_command("predictor", parameters))
            node = rclpy.create_node("latency")
            complete = qos.points_complete()
            points_out = node.create_publisher(PointCloud2, TRACKER_POINTS, complete)
            pose_out = node.create_publisher(PoseArray, GRIPPER_POSE, complete)
            closed_out = node.create_publisher(UInt8MultiArray, GRIPPER_CLOSED, complete)

            def received(message: PointCloud2) -> None:
                now = time.perf_counter()
                latency.append(now - sent[stamp_of(message)])

            node.create_subscription(PointCloud2, PREDICTION_POINTS, received, complete)
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            while points_out.get_subscription_count() < 1:
                if children.running["predictor"].poll() is not None:
                    raise SystemExit(children.last_line("predictor"))
                executor.spin_once(timeout_sec=0.1)
            begin, count = time.perf_counter(), round(seconds * case.rate)
            confidence = np.ones(len(case.rest), np.float32)
            for k in range(count + round(case.rate)):
                due = begin + k / case.rate
                while time.perf_counter() < due:
                    executor.spin_once(timeout_sec=max(0.0, due - time.perf_counter()))
                if k >= count:
                    continue
                stamp = BEGIN + round(k * 1e9 / case.rate)
                moved = np.array([[0.0, 0.0, 0.05 * np.sin(2 * np.pi * 0.5 * k / case.rate)]])
                frame = PointFrame(stamp, case.rest + moved, body.id, confidence, None)
                points_out.publish(convert.points_to_cloud(frame))
                closed_out.publish(convert.closed_to_message(np.array([True])))
                sent[stamp] = time.perf_counter()
                pose_out.publish(convert.pose_to_message(PoseFrame(stamp, case.rest[:1] + moved, np.eye(1, 4))))
            executor.shutdown()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return np.array(latency), len(sent), size


def main() -> int:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    for case in cases():
        with tempfile.TemporaryDirectory() as folder:
            latency, sent, size = measure(case, args.seconds, Path(folder))
        if not len(latency):
            print(f"{case.name}: no prediction came")
            continue
        p50, p99 = np.percentile(latency, (50, 99)) * 1e3
        in_time = float((latency < 1 / case.rate).mean())
        print(
            f"{case.name} at {case.rate:g} Hz ({size}): p50 {p50:.2f} ms, p99 {p99:.2f} ms, "
            f"{in_time:.1%} before the next pose, {sent - 2 - len(latency)} of {sent - 2} missing"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

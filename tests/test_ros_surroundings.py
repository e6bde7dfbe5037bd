"""What a node says of the others: a second publisher of its topics, simulated time that stands still."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from live_world import make_twin
from ros_bench import bench_of
from rosgraph_msgs.msg import Clock

from pred_ros import surroundings
from pred_ros.diagnostics import WARN
from pred_ros.predictor_node import PredictorNode


def test_a_second_publisher_is_named_once_it_has_lasted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surroundings, "RIVAL", 2.0)
    twin = make_twin(tmp_path / "twin")
    with bench_of(PredictorNode, {"twin": str(twin)}) as bench:  # the bench publishes predictions too
        bench.until(lambda: bench.says(WARN, "prediction/points has 2 publishers: /bench, /predictor"), "the rival")
        early = bench.statuses[0]
        assert "publishers" not in early.message, "at first it may be a dead one that discovery still remembers"
        bench.world.destroy_publisher(bench.prediction_out)
        bench.statuses.clear()
        bench.until(lambda: bench.statuses and "publishers" not in bench.statuses[-1].message, "it is gone")


def test_simulated_time_that_stands_still_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The nodes' own timers stand still with it."""
    monkeypatch.setattr(surroundings, "STILL", 0.5)
    twin = make_twin(tmp_path / "twin")
    with bench_of(PredictorNode, {"twin": str(twin), "use_sim_time": "true"}, feeds=False) as bench:
        bench.until(lambda: bench.says(WARN, "/clock stands still"), "no clock yet")
        clock, ticks = bench.world.create_publisher(Clock, "/clock", 10), 0

        def moves() -> bool:
            nonlocal ticks
            ticks += 1
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(ticks * 10_000_000, 10**9)
            clock.publish(message)
            return bool(bench.statuses) and "/clock" not in bench.statuses[-1].message

        bench.statuses.clear()
        bench.until(moves, "it moves")
        bench.statuses.clear()
        bench.until(lambda: bench.says(WARN, "/clock stands still"), "its sender has ended")

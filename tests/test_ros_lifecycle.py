"""The predictor node under load and through its lifecycle: what it drops it says, what it made it destroys."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticStatus
from live_world import CLOSED, START, STEP, pose
from predictor_bench import SlowPredictor, predictor_bench
from ros_bench import Bench

from pred_core.bag.wire import GRIPPER_POSE
from pred_ros import convert

WARN = DiagnosticStatus.WARN


@pytest.fixture
def bench(straight_twin: Path) -> Iterator[Bench]:
    with predictor_bench(straight_twin) as made:
        yield made


def test_too_slow_drops_to_the_newest_data_and_says_so(straight_twin: Path) -> None:
    with predictor_bench(straight_twin, SlowPredictor, overload="newest", max_backlog="0.1") as bench:

        def heard() -> int:
            return bench.node.diagnostics.counter("messages on tracker/points")

        def feed(frames: range) -> None:
            """A live reader keeps the newest few clouds: take each one before the next is sent."""
            for frame in frames:
                bench.feed(frame)
                count = heard() + 1
                bench.until(lambda: heard() >= count, "the cloud")  # noqa: B023

        feed(range(100))
        bench.until(lambda: bench.says(WARN, "too slow", "messages dropped"), "a warning")
        assert bench.node.diagnostics.counter("dropped messages") > 0
        feed(range(200, 206))
        newest = START + 205 * STEP
        bench.until(lambda: bench.predictions and bench.predictions[-1][0] == newest, "the newest data are predicted")
        assert bench.predictions[-1][1].position[4, 0] == pytest.approx(0.2 + 0.005 * 205, abs=1e-5)
        bench.node.heartbeat()
        assert bench.node.diagnostics.level == WARN, "it predicts again, and still says that messages were dropped"
        assert "too slow" in bench.node.diagnostics.message
        clock = time.monotonic() + 6.0
        bench.node.diagnostics._clock = lambda: clock
        bench.node.heartbeat()
        assert "too slow" not in bench.node.diagnostics.message, "six seconds later it does not"


def test_many_poses_at_once_are_no_overload(straight_twin: Path) -> None:
    """An arm may say where it is ten times a period: what counts is how long a message waits."""
    with predictor_bench(straight_twin, overload="newest", max_backlog="0.5") as bench:
        bench.until(lambda: bench.node._inputs, "the node listens")
        bench.node._closed = CLOSED
        count = 400  # 40 periods, which would take 0.4 s if they came as they were measured
        for k in range(count):
            one = dataclasses.replace(pose(0), stamp=START + k * STEP // 10)
            bench.node._on_pose(convert.pose_to_message(one))
        bench.until(lambda: bench.node._inbox.qsize() == 0, "all of them are taken")
        assert bench.node.diagnostics.counter(f"messages on {GRIPPER_POSE}") == count
        assert bench.node.diagnostics.counter("dropped messages") == 0


def test_queue_keeps_every_message_however_slow(straight_twin: Path) -> None:
    with predictor_bench(straight_twin, SlowPredictor, max_backlog="0.1") as bench:
        for frame in range(60):
            bench.feed(frame)
        bench.until(lambda: len(bench.predictions) == 58, "all of them")
        assert bench.node.diagnostics.counter("dropped messages") == 0


def test_cleanup_leaves_nothing_and_the_node_can_be_configured_again(bench: Bench) -> None:
    node = bench.node

    def made() -> list[int]:
        return [len(list(x)) for x in (node.publishers, node.services, node.subscriptions, node.timers)]

    bench.until(lambda: node._inputs, "the node listens")
    before = made()
    for _ in range(2):
        node.trigger_deactivate()
        node.trigger_cleanup()
        idle = made()
        assert all(a < b for a, b in zip(idle, before, strict=True)), "each kind is gone"
        node.trigger_configure()
        node.trigger_activate()
        bench.until(lambda: node._inputs, "the node listens again")
        assert made() == before, "nothing is doubled"
    bench.until(lambda: bench.points_out.get_subscription_count() == 1, "one reader")
    for frame in range(5):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 3, "it predicts")
    node.trigger_shutdown()
    assert node._worker is None and made() == idle, "shutdown from active ends the work"


def test_a_worker_within_a_long_horizon_ends_at_once(straight_twin: Path) -> None:
    with predictor_bench(straight_twin, SlowPredictor, horizon="5.0") as bench:
        for frame in range(10):
            bench.feed(frame)
        bench.until(lambda: bench.node._predictor.counts.steps > 0, "it steps; 500 steps of 20 ms follow")
        begin = time.monotonic()
        bench.node.stop()
        assert time.monotonic() - begin < 1.0  # not the 10 s of the horizon

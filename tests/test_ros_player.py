"""The player: what goes on the wire, in which order, with which stamps."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from geometry_msgs.msg import PoseArray
from live_world import points, pose
from rclpy.duration import Duration
from ros_bench import Bench, bench_of
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String, UInt8MultiArray
from std_srvs.srv import SetBool

from pred_core.bag.clouds import make_tracker_points
from pred_core.bag.dataset import load_dataset
from pred_core.bag.grippers import make_gripper_closed, make_gripper_pose
from pred_core.bag.playlist import find_clips, stream
from pred_core.bag.wire import stamp_of
from pred_core.bag.writer import BagWriter
from pred_core.live import marks
from pred_ros import convert, qos
from pred_ros.player_node import PlayerNode, unacknowledged

SAMPLE = Path(__file__).parents[1] / "bags" / "sample_cable"


class Listener:
    """Everything the player says, in order of arrival."""

    def __init__(self, bench: Bench):
        self.clouds: list[PointCloud2] = []
        self.poses: list[PoseArray] = []
        self.closed: list[UInt8MultiArray] = []
        self.marks: list[marks.Mark] = []
        complete = qos.points_complete()
        bench.world.create_subscription(UInt8MultiArray, "gripper/closed", self.closed.append, complete)
        bench.world.create_subscription(PoseArray, "gripper/pose", self.poses.append, complete)
        bench.world.create_subscription(PointCloud2, "tracker/points", self.clouds.append, complete)
        bench.world.create_subscription(
            String, marks.TOPIC, lambda m: self.marks.append(marks.decode(m.data)), qos.latched(1000)
        )


@contextmanager
def playing(**parameters: object) -> Iterator[tuple[Bench, Listener]]:
    """A player at 50 x real time and a listener."""
    values = {"factor": 50.0, **parameters}
    with bench_of(PlayerNode, {k: str(v) for k, v in values.items()}, feeds=False) as bench:
        yield bench, Listener(bench)


def bag_of(path: Path, frames: int, bad: int | None = None) -> Path:
    """A bag of the five-particle line; at frame `bad` a particle is NaN."""
    with BagWriter(path) as writer:
        for k in range(frames):
            seen, held = points(k), pose(k)
            if k == bad:
                seen.position[1] = np.nan
            writer.write("tracker/points", make_tracker_points(seen), seen.stamp)
            writer.write("gripper/pose", make_gripper_pose(held.stamp, held.position, held.rotation), held.stamp)
            writer.write("gripper/closed", make_gripper_closed(np.array([True])), held.stamp)
    return path


def test_every_message_arrives_with_its_capture_stamp_and_its_place(tmp_path: Path) -> None:
    with playing(bag=bag_of(tmp_path / "line.mcap", 80)) as (bench, heard):
        bench.until(lambda: bench.node.exit_code is not None, "the end of the data", limit=60.0)
        assert bench.node.exit_code == 0
        bench.until(lambda: len(heard.clouds) == len(heard.poses) == len(heard.closed) == 80, "every message")
    assert [stamp_of(c) for c in heard.clouds] == [points(k).stamp for k in range(80)]
    for k, cloud in enumerate(heard.clouds):
        assert np.array_equal(convert.cloud_to_points(cloud).position, points(k).position.astype(np.float32))
    begin, end = heard.marks
    assert isinstance(begin, marks.EpisodeMark) and (begin.begin, begin.frames, begin.shift) == (points(0).stamp, 80, 0)
    assert end == marks.EndMark(1)


def test_episodes_follow_each_other_without_running_backwards() -> None:
    with playing(bag=SAMPLE, split="test", pause=0.5) as (bench, heard):
        bench.until(lambda: bench.node.exit_code is not None, "the end of the data", limit=60.0)
        bench.until(lambda: len(heard.clouds) == 600, "every frame")
    stamps = np.array([stamp_of(c) for c in heard.clouds])
    steps = np.diff(stamps)
    assert (steps > 0).all()
    assert steps[299] >= 500_000_000  # the pause between the two episodes of 300 frames
    # The time between frames is that of the bag, to the nanosecond.
    captured = [e.stamps for e in load_dataset(SAMPLE).episodes("test")]
    assert np.array_equal(np.diff(stamps[:300]), np.diff(captured[0]))
    assert np.array_equal(np.diff(stamps[300:]), np.diff(captured[1]))


def test_capture_stamps_are_untouched_if_asked() -> None:
    with playing(bag=SAMPLE, episodes="ep005", stamps="capture") as (bench, heard):
        bench.until(lambda: bench.node.exit_code is not None, "the end of the data", limit=60.0)
        bench.until(lambda: len(heard.clouds) == 300, "every frame")
    (captured,) = [e.stamps for e in load_dataset(SAMPLE).episodes("test") if e.name == "ep005"]
    assert [stamp_of(c) for c in heard.clouds] == captured.tolist()


def test_loop_plays_again_and_pause_holds(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / "line.mcap", 20)
    with playing(bag=bag, loop=True, pause=0.1, factor=5.0) as (bench, heard):
        bench.until(lambda: len(heard.clouds) > 45, "a third round")
        assert (np.diff([stamp_of(c) for c in heard.clouds]) > 0).all()
        client = bench.world.create_client(SetBool, "/player/pause")
        bench.until(client.service_is_ready, "the service")
        answer = client.call_async(SetBool.Request(data=True))
        bench.until(answer.done, "an answer")
        settled = time.monotonic() + 0.3
        bench.until(lambda: time.monotonic() > settled, "what was on its way")
        held = len(heard.clouds)
        over = time.monotonic() + 0.3
        bench.until(lambda: time.monotonic() > over, "a pause in which 150 frames would have come")
        assert len(heard.clouds) <= held + 1
        answer = client.call_async(SetBool.Request(data=False))
        bench.until(lambda: len(heard.clouds) > held + 5, "it goes on")
        assert bench.node.exit_code is None


def test_a_bag_that_breaks_the_contract_ends_the_player(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with playing(bag=bag_of(tmp_path / "line.mcap", 20, bad=10)) as (bench, _):
        bench.until(lambda: bench.node.exit_code is not None, "the player gives up")
        assert bench.node.exit_code == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("player: line.mcap: tracker/points") and "not finite" in line and "\n" not in line


def test_a_truncated_bag_is_refused_before_anything_is_played(tmp_path: Path) -> None:
    whole = bag_of(tmp_path / "line.mcap", 200)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(ValueError, match="cut.mcap: truncated or damaged bag"):
        find_clips(cut)


def test_flags_come_before_the_poses_they_hold_for(tmp_path: Path) -> None:
    (clip,) = find_clips(bag_of(tmp_path / "line.mcap", 5))
    order = [m.topic for m in stream(clip)]
    assert order == ["gripper/closed", "gripper/pose", "tracker/points"] * 5


class Deaf:
    """A publisher whose reader never acknowledges."""

    def __init__(self) -> None:
        self.asked = 0

    def wait_for_all_acked(self, timeout: Duration) -> bool:
        """As long as it is told, in vain."""
        self.asked += 1
        time.sleep(timeout.nanoseconds * 1e-9)
        return False


def test_the_wait_for_readers_at_the_end_is_halted_at_once() -> None:
    outs = {"tracker/points": Deaf(), "gripper/pose": Deaf()}
    halted = threading.Event()
    threading.Timer(0.3, halted.set).start()
    begin = time.monotonic()
    assert unacknowledged(outs, 20.0, halted.is_set) == list(outs)
    assert time.monotonic() - begin < 1.0


def test_the_wait_for_readers_at_the_end_is_limited_for_all_together() -> None:
    class Heard(Deaf):
        def wait_for_all_acked(self, timeout: Duration) -> bool:
            return True

    begin = time.monotonic()
    outs = {"a": Heard(), "b": Deaf(), "c": Deaf()}
    assert unacknowledged(outs, 0.3, lambda: False) == ["b", "c"]
    assert time.monotonic() - begin < 1.0
    assert unacknowledged({"a": Heard()}, 0.3, lambda: False) == []

"""The predictor node fed over real topics: what it predicts, and how it answers bad input."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticStatus
from live_world import CLOSED, COUNT, PERIOD, START, STEP, Straight, points, pose
from predictor_bench import predictor_bench
from ros_bench import Bench, bench_of
from std_srvs.srv import Trigger

from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.twin import Twin
from pred_ros import convert
from pred_ros.predictor_node import PredictorNode

ERROR, WARN = DiagnosticStatus.ERROR, DiagnosticStatus.WARN


class DivergingPredictor(PredictorNode):
    """The node with a Dynamics that leaves the finite numbers at its fourth step."""

    MAKE_DYNAMICS = staticmethod(lambda twin: Straight(diverges_after=3))


@pytest.fixture
def bench(straight_twin: Path) -> Iterator[Bench]:
    with predictor_bench(straight_twin) as made:
        yield made


def test_prediction_carries_the_stamp_of_the_pose_and_the_hand_worked_place(bench: Bench) -> None:
    for frame in range(10):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) >= 8, "predictions for frames 2 to 9")
    assert [stamp for stamp, _ in bench.predictions] == [START + k * STEP for k in range(2, 10)]
    # 0.5 m/s along x: at frame 9 the last of five particles, 5 cm apart, is at 4 * 0.05 + 9 * 0.005 = 0.245 m.
    last = bench.predictions[-1][1]
    assert last.position[4].tolist() == pytest.approx([0.245, 0.0, 0.0], abs=2e-6)  # float32 on the wire, 8 sums
    assert last.velocity[4, 0] == pytest.approx(0.5, abs=1e-5)
    assert last.held.tolist() == [0, -1, -1, -1, -1]


def test_horizon_stands_in_the_stamp(straight_twin: Path) -> None:
    with predictor_bench(straight_twin, horizon="0.05") as bench:
        for frame in range(5):
            bench.feed(frame)
        bench.until(lambda: len(bench.predictions) >= 3, "predictions")
        stamp, state = bench.predictions[-1]
        assert stamp == START + 4 * STEP + 50_000_000
        # The gripper moves on at its last velocity, 0.5 m/s: frame 4 + 5 steps = 9 * 0.005 m.
        assert state.position[0, 0] == pytest.approx(0.045, abs=2e-6)
        assert state.position[4, 0] == pytest.approx(0.245, abs=2e-6)


def test_correction_follows_the_tracks_and_open_loop_does_not(straight_twin: Path) -> None:
    def moved(frame: int) -> PointFrame:
        """From frame 5 on everything is measured 2 cm higher."""
        seen = points(frame)
        seen.position[:, 2] += 0.02 if frame >= 5 else 0.0
        return seen

    heights = {}
    for mode in ("none", "tracks"):
        with predictor_bench(straight_twin, correct=mode) as bench:
            for frame in range(12):
                bench.points_out.publish(convert.points_to_cloud(moved(frame)))
            bench.until(lambda: bench.node.diagnostics.counter("messages on tracker/points") == 12, "points")  # noqa: B023
            for frame in range(12):
                bench.closed_out.publish(convert.closed_to_message(CLOSED))
                bench.pose_out.publish(convert.pose_to_message(pose(frame)))
            bench.until(lambda: len(bench.predictions) >= 8, "predictions")  # noqa: B023
            heights[mode] = float(bench.predictions[-1][1].position[4, 2])
    assert heights["none"] == pytest.approx(0.0, abs=1e-6)
    assert heights["tracks"] == pytest.approx(0.02, abs=1e-6)


def test_wrong_frame_is_refused_with_its_name(bench: Bench) -> None:
    cloud = convert.points_to_cloud(points(0))
    cloud.header.frame_id = "camera"
    bench.points_out.publish(cloud)
    bench.until(lambda: bench.says(ERROR, "frame_id", "camera", "world"), "an error that names the frame")
    assert bench.node.exit_code is None


def test_missing_field_is_refused_with_its_name(bench: Bench) -> None:
    cloud = convert.points_to_cloud(points(0))
    cloud.fields = [f for f in cloud.fields if f.name != "id"]
    bench.points_out.publish(cloud)
    bench.until(lambda: bench.says(ERROR, "no field 'id'"), "an error that names the field")


def test_nan_cloud_is_refused_and_the_run_goes_on(bench: Bench) -> None:
    for frame in range(4):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 2, "predictions for frames 2 and 3")
    bad = points(4)
    bad.position[2] = np.nan
    bench.points_out.publish(convert.points_to_cloud(bad))
    bench.until(lambda: bench.says(ERROR, "ids 2 are not finite"), "an error that names the particle")
    for frame in range(4, 7):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 5, "predictions go on")
    assert all(np.isfinite(state.position.numpy()).all() for _, state in bench.predictions)


def test_nan_pose_is_refused(bench: Bench) -> None:
    bench.closed_out.publish(convert.closed_to_message(CLOSED))
    bad = PoseFrame(START, np.full((1, 3), np.nan), np.array([[1.0, 0.0, 0.0, 0.0]]))
    bench.pose_out.publish(convert.pose_to_message(bad))
    bench.until(lambda: bench.says(ERROR, "gripper pose is not finite"), "an error")


def test_ids_of_another_object_end_the_node_with_code_2(bench: Bench, capsys: pytest.CaptureFixture) -> None:
    bench.points_out.publish(convert.points_to_cloud(points(0, ids=COUNT + 2)))
    bench.until(lambda: bench.node.exit_code is not None, "the node gives up")
    assert bench.node.exit_code == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("predictor: the particle ids of tracker/points do not match the twin") and "\n" not in line
    assert "[5, 6]" in line


def test_stamps_running_backwards_are_refused(bench: Bench) -> None:
    for frame in range(6):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 4, "predictions for frames 2 to 5")
    bench.pose_out.publish(convert.pose_to_message(pose(3)))
    bench.until(lambda: bench.says(ERROR, "gripper/pose: time runs backwards"), "an error")
    bench.feed(6)
    bench.until(lambda: len(bench.predictions) == 5, "the run goes on")


def test_a_loop_starts_a_new_run(bench: Bench) -> None:
    for frame in itertools.chain(range(40), range(10)):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 38 + 8, "both rounds are predicted")
    assert [s for s, _ in bench.predictions[38:]] == [START + k * STEP for k in range(2, 10)]


def test_a_gap_of_a_second_ends_the_run_and_the_next_frames_start_one(bench: Bench) -> None:
    for frame in itertools.chain(range(5), range(105, 110)):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 3 + 3, "both runs are predicted")
    # Frames 105 and 106 are the new start; nothing is predicted across the hole.
    assert [round((s - START) / STEP) for s, _ in bench.predictions] == [2, 3, 4, 107, 108, 109]
    assert bench.node._predictor.counts.gaps == 1


def test_poses_that_stop_are_said_and_nothing_is_predicted(bench: Bench) -> None:
    for frame in range(5):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 3, "predictions")
    frame = itertools.count(5)

    def tracks_only() -> bool:
        bench.points_out.publish(convert.points_to_cloud(points(next(frame))))
        return bench.says(ERROR, "gripper/pose stopped", "no prediction")

    bench.until(tracks_only, "an error about the missing poses")
    assert len(bench.predictions) == 3


def test_hidden_particle_is_named_while_no_start_is_possible(bench: Bench) -> None:
    frame = itertools.count()

    def feed_with_one_hidden() -> bool:
        k = next(frame)
        seen = points(k)
        bench.closed_out.publish(convert.closed_to_message(CLOSED))
        bench.pose_out.publish(convert.pose_to_message(pose(k)))
        shown = PointFrame(seen.stamp, seen.position[:-1], seen.id[:-1], seen.confidence[:-1], None)
        bench.points_out.publish(convert.points_to_cloud(shown))
        return bench.says(WARN, "particles [4] are not seen")

    bench.until(feed_with_one_hidden, "a warning that names particle 4")
    assert not bench.predictions


def test_divergence_stops_before_the_wire_and_reset_starts_anew(straight_twin: Path) -> None:
    with predictor_bench(straight_twin, DivergingPredictor) as bench:
        for frame in range(10):
            bench.feed(frame)
        bench.until(lambda: bench.says(ERROR, "diverged at stamp 7.050 s", "~/reset"), "an error with the stamp")
        bench.until(lambda: len(bench.predictions) >= 3, "the predictions before it")
        assert len(bench.predictions) == 3  # frames 2, 3, 4; the fourth step was not finite
        assert all(np.isfinite(state.position.numpy()).all() for _, state in bench.predictions)
        bench.node._dynamics.left = 10**9
        client = bench.world.create_client(Trigger, "/predictor/reset")
        bench.until(client.service_is_ready, "the service")
        answer = client.call_async(Trigger.Request())
        bench.until(answer.done, "an answer")
        assert answer.result().success
        for frame in range(10, 15):
            bench.feed(frame)
        bench.until(lambda: len(bench.predictions) == 3 + 3, "a new run from frames 10 and 11")


def test_poses_twice_as_fast_are_taken_at_the_period(bench: Bench) -> None:
    """200 Hz poses, 100 Hz tracks: the steps use the poses on the grid, exactly."""
    for frame in range(8):
        bench.feed(frame)
        between = pose(frame)
        half = PoseFrame(between.stamp + STEP // 2, between.position + [[0.25 * PERIOD, 0, 0]], between.rotation)
        bench.pose_out.publish(convert.pose_to_message(half))
    bench.until(lambda: len(bench.predictions) == 6, "predictions")
    assert [s for s, _ in bench.predictions] == [START + k * STEP for k in range(2, 8)]
    assert bench.node._predictor.counts.interpolated == 0


def test_twin_of_another_rate_is_said(tmp_path: Path, straight_twin: Path) -> None:
    class Slow(Straight):
        period = 1 / 30

    class SlowPredictor(PredictorNode):
        MAKE_DYNAMICS = staticmethod(lambda _: Slow())

    assert Twin.load(straight_twin).body.count == COUNT
    with bench_of(SlowPredictor, {"twin": str(straight_twin), "overload": "queue"}) as bench:
        frame = itertools.count()

        def feed() -> bool:
            bench.feed(next(frame))
            return bench.says(WARN, "frames come 0.01 s apart, the twin steps 0.0333333 s")

        bench.until(feed, "a warning that names both periods")


def test_a_cloud_without_points_does_not_end_the_node(bench: Bench) -> None:
    for frame in range(4):
        bench.feed(frame)
    bench.until(lambda: len(bench.predictions) == 2, "predictions for frames 2 and 3")
    bench.points_out.publish(convert.points_to_cloud(points(4, ids=0)))
    bench.pose_out.publish(convert.pose_to_message(pose(4)))
    bench.feed(5)
    bench.until(lambda: len(bench.predictions) == 4, "predictions go on")
    assert bench.node.exit_code is None

"""The predictor node in mode `estimate`: it follows the tracks, and says when it cannot."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticStatus
from live_world import CLOSED, COUNT, PERIOD, START, STEP, points, pose
from predictor_bench import predictor_bench
from ros_bench import Bench

from pred_core.errors import ConfigError
from pred_ros import convert
from pred_ros.predictor_node import PredictorConfig, check

ERROR, WARN, OK = DiagnosticStatus.ERROR, DiagnosticStatus.WARN, DiagnosticStatus.OK
STOP = 3.0  # [s]


@pytest.fixture
def bench(straight_twin: Path) -> Iterator[Bench]:
    with predictor_bench(straight_twin, mode="estimate", stop_after=str(STOP)) as made:
        yield made


class Stream:
    """Poses and tracks at their own pace, 100 Hz; `height(frame)` [m] is added to free particles, None: no tracks."""

    def __init__(self, bench: Bench):
        self.bench, self.frame, self._due = bench, 0, 0.0

    def go(self, height: Callable[[int], np.ndarray | None]) -> None:
        """The next frame, if it is time for it."""
        if time.monotonic() < self._due:
            return
        self._due = time.monotonic() + PERIOD
        self.bench.closed_out.publish(convert.closed_to_message(CLOSED))
        self.bench.pose_out.publish(convert.pose_to_message(pose(self.frame)))
        raised = height(self.frame)
        if raised is not None:
            seen = points(self.frame)
            seen.position[:, 2] += raised
            self.bench.points_out.publish(convert.points_to_cloud(seen))
        self.frame += 1

    def until(self, height: Callable[[int], np.ndarray | None], condition: Callable[[], bool], what: str) -> None:
        """Stream until the condition holds."""

        def step() -> bool:
            self.go(height)
            return condition()

        self.bench.until(step, what, limit=60.0)


def level(_: int) -> np.ndarray:
    """As the model has it."""
    return np.zeros(COUNT)


def test_it_follows_what_the_model_does_not_know(bench: Bench) -> None:
    """From frame 60 on the line rises by 5 cm/s; after a second the last particle is 5 cm higher, 1 cm at most off."""

    def rising(frame: int) -> np.ndarray:
        return np.array([0.0, 1.0, 1.0, 1.0, 1.0]) * 0.05 * PERIOD * max(0, frame - 60)

    stream = Stream(bench)
    end = START + 160 * STEP
    stream.until(rising, lambda: bool(bench.predictions) and bench.predictions[-1][0] >= end, "frame 160")
    stamp, state = bench.predictions[-1]
    frame = (stamp - START) / STEP
    assert state.position[4].tolist() == pytest.approx([0.2 + 0.005 * frame, 0.0, 0.0005 * (frame - 60)], abs=0.01)
    assert state.velocity[4, 2] == pytest.approx(0.05, abs=0.02)
    stream.until(rising, lambda: bench.says(OK, "following the tracks"), "a word that all is well")


def test_without_tracks_it_warns_then_stops_then_goes_on(bench: Bench) -> None:
    stream = Stream(bench)
    stream.until(level, lambda: len(bench.predictions) > 50, "a run")
    stream.until(lambda _: None, lambda: bench.says(WARN, "no tracks for", "model alone"), "a warning")
    stream.until(lambda _: None, lambda: bench.says(ERROR, "no tracks for", "no state is given"), "an error")
    count, last = len(bench.predictions), stream.frame
    stream.until(lambda _: None, lambda: stream.frame > last + 50, "half a second more")
    assert len(bench.predictions) == count
    stream.until(level, lambda: len(bench.predictions) > count + 20, "states again")
    bench.statuses.clear()
    stream.until(level, lambda: bench.says(OK, "following the tracks"), "a word that all is well")


def test_a_wrong_track_is_counted(bench: Bench) -> None:
    def one_wrong(frame: int) -> np.ndarray:
        return np.array([0.0, 0.0, 0.1 if frame > 60 else 0.0, 0.0, 0.0])

    def counted() -> bool:
        values = [{v.key: v.value for v in s.values} for s in bench.statuses]
        return any(v.get("tracks rejected in the newest frame") == "1 of 4" for v in values)

    Stream(bench).until(one_wrong, counted, "a count of rejected tracks")
    assert float(bench.predictions[-1][1].position[2, 2].abs()) < 1e-3


def test_lost_is_said_and_it_starts_anew(bench: Bench) -> None:
    """30 cm higher from one frame to the next: contradicted for half a second, then believed."""

    def jump(frame: int) -> np.ndarray:
        return np.array([0.0, 1.0, 1.0, 1.0, 1.0]) * (0.3 if frame > 60 else 0.0)

    stream = Stream(bench)
    stream.until(jump, lambda: bench.says(WARN, "was lost", "4 of 4 tracks", "started anew"), "a warning")
    height = float(bench.predictions[-1][1].position[4, 2])
    # The new shape keeps the lengths of the twin, so the line comes to lie aslant: the free end is near, not exact.
    assert height > 0.1


def test_an_estimate_is_not_also_restarted_from_every_frame() -> None:
    with pytest.raises(ConfigError, match="correct"):
        check(PredictorConfig(mode="estimate", correct="tracks"))

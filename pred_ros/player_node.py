"""The player: replays the bags of a data set (or one bag) as the topics of the wire, and loses nothing.

Out: tracker/points, gripper/pose, gripper/closed (latched too), pictures of cameras, unpacked if they are compressed
(a slow reader loses some), player/episode (marks.py), /clock if asked.
`~/pause` (SetBool). At the end of the data it waits until every reader has everything, then exits 0.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NoReturn

from geometry_msgs.msg import PoseArray
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String, UInt8MultiArray
from std_srvs.srv import SetBool

from pred_core.bag.playlist import Clip, Timed, find_clips, stream
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS
from pred_core.config import setting
from pred_core.errors import ConfigError, InputError, PredError
from pred_core.live import marks
from pred_ros import convert, qos, shell
from pred_ros.diagnostics import OK, WARN
from pred_ros.played_pictures import PlayedPictures
from pred_ros.shell import Shell

LATE = 0.05  # [s] behind its schedule before the player says so
FLUSH = 20.0  # [s] for the readers to acknowledge the last messages
SLICE = 0.1  # [s] of that at once
_CLASSES: dict[str, type] = {TRACKER_POINTS: PointCloud2, GRIPPER_POSE: PoseArray, GRIPPER_CLOSED: UInt8MultiArray}


@dataclass(frozen=True)
class PlayerConfig:
    """Parameters of the player."""

    bag: str = setting("", doc="data set folder or bag file")
    split: str = setting("all", choices=("all", "train", "test", "ood"), doc="episodes of a data set to play")
    episodes: str = setting("", doc="names of the episodes to play, separated by commas; empty: all of the split")
    factor: float = setting(1.0, unit="x real time", low=0.01, high=1000.0, doc="speed")
    stamps: str = setting(
        "continuous",
        choices=("continuous", "capture", "now"),
        doc="capture stamps moved so that episodes follow each other; or as captured; or moved to begin now",
    )
    loop: bool = setting(False, doc="start again at the end of the data")
    pause: float = setting(1.0, unit="s", low=0.0, high=60.0, doc="between the stamps of two episodes")
    wait_for: int = setting(1, low=0, high=64, doc="readers of tracker/points and gripper/pose to wait for")
    patience: float = setting(30.0, unit="s", low=0.1, high=3600.0, doc="longest wait for readers")
    clock: bool = setting(False, doc="publish /clock")
    points: bool = setting(True, doc="play tracker/points; false: leave that to a tracker that sees the pictures")
    autostart: bool = setting(True, doc="configure and activate without a lifecycle manager")


def unacknowledged(outs: Mapping[str, Publisher], limit: float, halted: Callable[[], bool]) -> list[str]:
    """Topics whose readers did not acknowledge everything within `limit` [s]; looks at `halted` every SLICE."""
    deadline = time.monotonic() + limit
    waiting = list(outs)
    while waiting and not halted():
        if outs[waiting[0]].wait_for_all_acked(Duration(seconds=SLICE)):
            waiting.pop(0)
        elif time.monotonic() > deadline:
            break
    return waiting


class PlayerNode(Shell):
    """Reads and publishes in one thread; the executor serves parameters, services and diagnostics."""

    NAME: ClassVar[str] = "player"
    CONFIG: ClassVar[type] = PlayerConfig
    PICTURES: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__()
        self._halt = threading.Event()
        self._go = threading.Event()
        self._worker: Future[None] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="player")
        self._clips: list[Clip] = []

    def setup(self) -> None:
        """Find the bags and make the publishers."""
        config: PlayerConfig = self.config
        if not config.bag:
            raise InputError(
                "parameter 'bag' is empty", next_step="ros2 run pred_ros player --ros-args -p bag:=DATASET"
            )
        if config.stamps == "now" and config.factor != 1.0:
            raise ConfigError(
                "stamps 'now' keeps the time between frames", got=f"factor {config.factor:g}", allowed="factor 1"
            )
        names = tuple(n for n in config.episodes.split(",") if n)
        self._clips = find_clips(Path(config.bag), config.split, names, config.points)
        complete = qos.points_complete()
        self._out: dict[str, Publisher] = {
            TRACKER_POINTS: self.create_publisher(PointCloud2, TRACKER_POINTS, complete),
            GRIPPER_POSE: self.create_publisher(PoseArray, GRIPPER_POSE, complete),
            GRIPPER_CLOSED: self.create_publisher(UInt8MultiArray, GRIPPER_CLOSED, qos.latched(qos.COMPLETE_DEPTH)),
        }
        self._pictures = PlayedPictures(self, sorted({t for c in self._clips for t in c.cameras}))
        self._marks_out = self.create_publisher(String, marks.TOPIC, qos.latched(1000))
        self._clock_out = self.create_publisher(Clock, "/clock", 10) if config.clock else None
        self.create_service(SetBool, "~/pause", self._on_pause)

    def start(self) -> None:
        """Begin to play."""
        self._halt.clear()
        self._go.set()
        self._worker = self._pool.submit(self._play)
        self._watch = self.create_timer(0.05, self._check_worker)

    def stop(self) -> None:
        """End the replay."""
        if self._worker is None:
            return
        self._worker = None
        self._halt.set()
        self._go.set()
        self.destroy_timer(self._watch)
        self._pool.shutdown(wait=True)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="player")

    def changed(self, config: PlayerConfig) -> None:
        """Only the speed may change while it plays."""
        kept = {k: v for k, v in vars(config).items() if k not in ("factor", "loop")}
        changed = [k for k, v in kept.items() if getattr(self.config, k) != v]
        if changed and self._worker is not None:
            raise ConfigError(
                f"'{changed[0]}' cannot change while the player is active", next_step="Deactivate it first"
            )

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._go.clear()
        else:
            self._go.set()
        response.success, response.message = True, "paused" if request.data else "playing"
        return response

    def _check_worker(self) -> None:
        if self._worker is None or not self._worker.done():
            return
        try:
            self._worker.result()
        except PredError as error:
            self.fail(error)
            return
        if self.exit_code is None:
            self.exit_code = 0

    # Below: the worker thread.

    def _play(self) -> None:
        self._wait_for_readers()
        begin_at: int | None = None  # [ns] earliest stamp of the next episode
        played = 0
        while not self._halt.is_set():
            for index, clip in enumerate(self._clips):
                begin_at = self._play_clip(clip, index, begin_at)
                played += 1
                if self._halt.is_set():
                    return
            if not self.config.loop:
                break
        self._marks_out.publish(String(data=marks.encode(marks.EndMark(played))))
        lost = unacknowledged({**self._out, marks.TOPIC: self._marks_out}, FLUSH, self._halt.is_set)
        if self._halt.is_set():
            return
        if lost:
            raise InputError(f"a reader of {', '.join(lost)} did not take everything within {FLUSH:g} s")
        self.report(OK, f"end of data: {played} episodes, {self.diagnostics.counter('messages')} messages")

    def _wait_for_readers(self) -> None:
        deadline = time.monotonic() + self.config.patience
        points, color = any(TRACKER_POINTS in c.topics for c in self._clips), self._pictures.color
        leading = self._out[TRACKER_POINTS] if points or color is None else color
        while not self._halt.is_set():
            found = {p.topic: p.get_subscription_count() for p in (leading, self._out[GRIPPER_POSE])}
            # The evaluator reads no poses: the poses need one reader, the points all of them.
            if found[leading.topic] >= self.config.wait_for and min(found.values()) >= min(1, self.config.wait_for):
                return
            if time.monotonic() > deadline:
                raise InputError(
                    f"no reader within {self.config.patience:g} s",
                    got=f"{found}",
                    allowed=f"wait_for {self.config.wait_for}",
                    next_step="Start the predictor, or set wait_for to 0",
                )
            self.report(WARN, "waiting for readers")
            self._halt.wait(0.02)

    def _play_clip(self, clip: Clip, index: int, begin_at: int | None) -> int:
        """Play one episode; returns the earliest stamp for the next [ns]."""
        shift = self._shift(clip, begin_at)
        mark = marks.EpisodeMark(
            name=clip.name,
            index=index,
            count=len(self._clips),
            begin=clip.begin + shift,
            frames=clip.frames,
            shift=shift,
            split=clip.split,
            recording=clip.recording,
            kind=clip.kind,
        )
        self._marks_out.publish(String(data=marks.encode(mark)))
        self.report(OK, f"playing {clip.name} ({index + 1} of {len(self._clips)})")
        self.diagnostics.value("episode", clip.name)
        last = clip.begin
        wall, media = time.monotonic(), 0.0
        for message in stream(clip):
            elapsed = (message.stamp - clip.begin) * 1e-9
            wall, media = self._wait_until(wall, media, elapsed)
            if self._halt.is_set():
                break
            self._publish(message, shift)
            last = max(last, message.stamp)
        self.diagnostics.count("episodes")
        return last + shift + round(self.config.pause * 1e9)

    def _shift(self, clip: Clip, begin_at: int | None) -> int:
        if self.config.stamps == "capture":
            return 0
        if self.config.stamps == "now":
            return self.get_clock().now().nanoseconds - clip.begin
        return 0 if begin_at is None else max(0, begin_at - clip.begin)

    def _wait_until(self, wall: float, media: float, elapsed: float) -> tuple[float, float]:
        """Sleep until `elapsed` [s] of the episode is due; returns the new pair of wall and media time."""
        due = wall + (elapsed - media) / self.config.factor
        if not self._go.is_set():
            self._go.wait()
            due = time.monotonic()
        late = time.monotonic() - due
        if late < 0:
            self._halt.wait(-late)
        elif late > LATE:
            self.diagnostics.count("late messages")
        return due, elapsed

    def _publish(self, message: Timed, shift: int) -> None:
        if message.topic not in self._out:
            if self._pictures.play(message.topic, message.data, message.stamp + shift):
                self.diagnostics.count("pictures and calibrations")
            return
        decoded: Any = deserialize_message(message.data, _CLASSES[message.topic])
        if message.topic != GRIPPER_CLOSED:
            decoded.header.stamp = convert.time_at(message.stamp + shift)
        if self._clock_out is not None:
            self._clock_out.publish(Clock(clock=convert.time_at(message.stamp + shift)))
        self._out[message.topic].publish(decoded)
        self.diagnostics.count("messages")
        self.diagnostics.count(f"messages on {message.topic}")


def main() -> NoReturn:
    """Entry point of `ros2 run pred_ros player`."""
    shell.main(PlayerNode)


if __name__ == "__main__":
    main()

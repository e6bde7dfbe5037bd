"""What a bag or a data set holds, what breaks the contract and what looks wrong: the facts behind `pred info`."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.align import align_flags, align_poses
from pred_core.bag.clouds import PointFrame, read_tracker_points
from pred_core.bag.dataset import Dataset, EpisodeEntry
from pred_core.bag.episode import check_forward, flag_times, regular_stamps
from pred_core.bag.gate import EpisodeQuality, examine_all
from pred_core.bag.grippers import read_gripper_closed, read_gripper_pose
from pred_core.bag.reader import BagMessage, BagReader, open_bag
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, REQUIRED, TRACKER_POINTS, TYPES, typestore
from pred_core.errors import BagError
from pred_core.types import Episode

BURSTS = 100.0  # times the median step that the mean one has only where messages come in bursts
LATE = 1.5  # periods between two messages from which one counts as lost


@dataclass
class TopicSummary:
    """One topic; times from header stamps where the type has them."""

    topic: str
    type: str
    count: int
    clock: str  # "header" or "log"
    rate: float = 0.0  # [Hz] 1 / median period
    seconds: float = 0.0  # [s] first to last
    jitter: float = 0.0  # [periods] standard deviation of the period
    largest_gap: float = 0.0  # [s]
    lost: int = 0  # messages missing in gaps of more than LATE periods
    backwards: int = 0  # steps back in time


@dataclass
class BagSummary:
    """A bag, as far as it can be read."""

    path: str
    bytes: int
    messages: int
    seconds: float  # [s] by log time
    topics: list[TopicSummary]
    cameras: list[str]
    particles: int = 0
    hidden: float = 0.0  # share of particles x messages not measured
    grippers: int = 0
    low: list[float] | None = None  # [m] smallest x y z of visible points
    high: list[float] | None = None  # [m]
    damage: str | None = None
    problems: list[str] = field(default_factory=list)  # what stands between the bag and `pred identify`


@dataclass
class DatasetSummary:
    """A data set: its episodes, their quality, what cannot be read."""

    path: str
    object: str
    kind: str
    rate: float  # [Hz]
    sigma: float | None  # [m]
    known: dict[str, Any]
    splits: dict[str, int]  # episodes a split
    recordings: int
    shared_recordings: list[int]  # recordings with episodes in train and in test: the split leaks
    seconds: float  # [s] of readable episodes
    episodes: list[EpisodeQuality]
    problems: list[str]


class _Clock:
    """Stamps of one topic; 8 bytes a message are kept."""

    def __init__(self, has_header: bool):
        self.has_header = has_header
        self.stamps = array("q")

    def add(self, message: BagMessage) -> None:
        if self.has_header and len(message.data) >= 12:
            order = "<" if message.data[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack(order + "iI", message.data[4:12])
            self.stamps.append(seconds * 1_000_000_000 + nanoseconds)
        else:
            self.stamps.append(message.log_time)

    def fill(self, topic: TopicSummary) -> None:
        stamps = np.array(self.stamps, np.int64)
        steps = np.diff(stamps) * 1e-9
        if not len(steps):
            return
        topic.seconds = float(stamps.max() - stamps.min()) * 1e-9
        topic.backwards = int((steps <= 0).sum()) if self.has_header else int((steps < 0).sum())
        topic.largest_gap = float(steps.max())
        period = float(np.median(steps))
        if period > 0:
            topic.rate = 1.0 / period
            regular = steps[(steps > 0) & (steps < LATE * period)]
            topic.jitter = float(regular.std() / period) if len(regular) else 0.0
            # Where several senders write in bursts, no period says what is missing.
            if period * BURSTS > steps.mean():
                topic.lost = int(np.round(steps[steps >= LATE * period] / period - 1.0).sum())


def summarize_bag(path: Path | str) -> BagSummary:
    """Read a bag once as far as it goes, one chunk in memory at a time; 16 bytes a message (its times) are kept.

    `problems` is empty where `read_episode` would read the bag: every message of the required topics is checked by
    itself, then that time runs forwards, frames have no long gap, and poses and flags cover every frame. What needs
    dataset.yaml (rate, who is held) is checked with the data set. Raises: BagError only if it is not a bag at all.
    """
    reader = open_bag(path)
    summary = BagSummary(
        path=str(reader.path),
        bytes=reader.path.stat().st_size,
        messages=reader.message_count,
        seconds=reader.duration,
        topics=[TopicSummary(i.topic, i.type, i.count, _clock_name(i.type)) for i in reader.topics.values()],
        cameras=list(reader.cameras),
    )
    clocks = {t.topic: _Clock(t.clock == "header") for t in summary.topics}
    contract = _Contract()
    for message in reader.read_messages(partial=True):
        clocks[message.topic].add(message)
        if message.topic in REQUIRED and message.type == TYPES[message.topic]:
            contract.add(message)
    for topic in summary.topics:
        clocks[topic.topic].fill(topic)
    contract.fill(summary)
    summary.damage = reader.damage
    summary.problems = _problems(reader, contract)
    return summary


def summarize_dataset(dataset: Dataset, progress: Callable[[int, int, str], None]) -> DatasetSummary:
    """Read every bag, run the data gate, list what cannot be read. Each bag is read twice, one at a time."""
    problems: dict[str, str] = {}
    total, done = 2 * len(dataset.entries), 0

    def readable() -> Iterator[Episode]:
        nonlocal done
        for entry in dataset.entries:
            if entry.bag not in problems:
                try:
                    yield dataset.read(entry)
                except BagError as error:
                    problems[entry.bag] = str(error)
            done += 1
            progress(done, total, entry.bag)

    qualities = examine_all(readable)
    lines = list(problems.values())
    for split in ("train", "test"):
        if split not in dataset.splits:
            lines.append(f"split '{split}' is empty: {_NEEDED_BY[split]} needs it")
    return DatasetSummary(
        path=str(dataset.root),
        object=dataset.object.name,
        kind=dataset.object.kind,
        rate=dataset.rate,
        sigma=dataset.sigma,
        known=dataset.known,
        splits={s: len(dataset.select(s)) for s in dataset.splits},
        recordings=len({e.recording for e in dataset.entries}),
        shared_recordings=_shared(dataset.entries),
        seconds=sum(q.seconds for q in qualities),
        episodes=qualities,
        problems=lines,
    )


_NEEDED_BY = {"train": "pred identify", "test": "pred evaluate"}


class _Contract:
    """Checks messages of the required topics one by one; keeps the first problem of each topic and their number."""

    def __init__(self) -> None:
        self.first: dict[str, str] = {}
        self.count: dict[str, int] = {}
        self.ids: set[int] = set()
        self.visible = 0
        self.frames = 0
        self.grippers = 0
        self.low: NDArray[np.float64] = np.full(3, np.inf)
        self.high: NDArray[np.float64] = np.full(3, -np.inf)
        self._last: dict[str, list[int]] = {}
        self._point_stamps = array("q")  # [ns]
        self._pose_stamps = array("q")  # [ns]
        self._pose_log = array("q")  # [ns]
        self._flag_log = array("q")  # [ns]
        self._pose_sizes: set[int] = set()
        self._flag_sizes: set[int] = set()

    def add(self, message: BagMessage) -> None:
        """Check one message."""
        try:
            if message.topic == TRACKER_POINTS:
                frame = read_tracker_points(message.decode(), message.where)
                self._forward(message, frame.stamp)
                self._point_stamps.append(frame.stamp)
                self._points(frame)
            elif message.topic == GRIPPER_POSE:
                pose = read_gripper_pose(message.decode(), message.where)
                self._forward(message, pose.stamp)
                self._poses(message, pose.stamp, len(pose.position))
            elif message.topic == GRIPPER_CLOSED:
                self._flag_sizes.add(len(read_gripper_closed(message.decode(), message.where)))
                self._flag_log.append(message.log_time)
        except BagError as error:
            self.first.setdefault(message.topic, str(error))
            self.count[message.topic] = self.count.get(message.topic, 0) + 1

    def fill(self, summary: BagSummary) -> None:
        """Put what was found into the summary."""
        summary.particles, summary.grippers = len(self.ids), self.grippers
        if self.frames and self.ids:
            summary.hidden = 1.0 - self.visible / (self.frames * len(self.ids))
        if np.isfinite(self.low).all():
            summary.low, summary.high = self.low.tolist(), self.high.tolist()

    def check_times(self, bag: str) -> None:
        """What `read_episode` checks once all messages are there, by their times alone. Raises: BagError."""
        points, poses, pose_log, flag_log = (
            np.array(a, np.int64) for a in (self._point_stamps, self._pose_stamps, self._pose_log, self._flag_log)
        )
        if len(points) < 2:
            raise BagError(f"{bag}: an episode needs at least 2 messages on {TRACKER_POINTS}", got=len(points))
        if not self.ids:
            raise BagError(f"{bag}: {TRACKER_POINTS} holds no particles in any message")
        frames, _ = regular_stamps(points, None, bag)
        # No grippers in the arrays: the times alone are aligned.
        align_poses(frames, poses, np.zeros((len(poses), 0, 3)), np.zeros((len(poses), 0, 4)), f"{bag}: {GRIPPER_POSE}")
        if self._flag_sizes != self._pose_sizes:
            raise BagError(
                f"{bag}: {GRIPPER_CLOSED} has {sorted(self._flag_sizes)} flags a message",
                allowed=f"{self.grippers}, one a pose",
            )
        flags = np.sort(flag_times(flag_log, pose_log, poses))
        align_flags(frames, flags, np.zeros((len(flags), 0), np.bool_), f"{bag}: {GRIPPER_CLOSED}")

    def _poses(self, message: BagMessage, stamp: int, grippers: int) -> None:
        self._pose_stamps.append(stamp)
        self._pose_log.append(message.log_time)
        self.grippers = max(self.grippers, grippers)
        if self._pose_sizes and grippers not in self._pose_sizes:
            (usual,) = self._pose_sizes
            raise BagError(f"{message.where}: the number of grippers changes", got=f"{usual}, then {grippers}")
        self._pose_sizes.add(grippers)

    def _forward(self, message: BagMessage, stamp: int) -> None:
        before = self._last.get(message.topic, [])
        self._last[message.topic] = [stamp]
        check_forward(before, stamp, message.where)

    def _points(self, frame: PointFrame) -> None:
        self.frames += 1
        self.ids.update(frame.id.tolist())
        seen = frame.position[frame.visible]
        self.visible += len(seen)
        if len(seen):
            self.low = np.minimum(self.low, seen.min(axis=0))
            self.high = np.maximum(self.high, seen.max(axis=0))


def _problems(reader: BagReader, contract: _Contract) -> list[str]:
    lines = []
    if reader.damage:
        lines.append(f"truncated or damaged: {reader.damage} {reader.message_count} messages before it can be read.")
    for topic in REQUIRED:
        try:
            reader.require([topic])
        except BagError as error:
            lines.append(str(error))
    for topic, first in contract.first.items():
        more = contract.count[topic] - 1
        lines.append(first + (f" {more} more messages of {topic} are refused." if more else ""))
    if not lines:
        try:
            contract.check_times(reader.path.name)
        except BagError as error:
            lines.append(str(error))
    return lines


def _clock_name(type_name: str) -> str:
    store = typestore()
    if type_name not in store.types:
        return "log"
    fields = store.get_msgdef(type_name).fields
    return "header" if fields and fields[0][0] == "header" else "log"


def _shared(entries: tuple[EpisodeEntry, ...]) -> list[int]:
    by_split = {s: {e.recording for e in entries if e.split == s} for s in ("train", "test")}
    return sorted(by_split["train"] & by_split["test"])

"""Recorded pictures to tracks: bags of cameras and a gripper become a data set, causally, as a live tracker would."""

from __future__ import annotations

import functools
import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.bag import images
from pred_core.bag.align import median_period
from pred_core.bag.clouds import PointFrame, make_tracker_points
from pred_core.bag.dataset import FILE, Dataset, EpisodeEntry, file_sha256, load_dataset, write_dataset
from pred_core.bag.deform import claim_folder
from pred_core.bag.episode import read_episode
from pred_core.bag.grippers import read_gripper_closed, read_gripper_pose
from pred_core.bag.playlist import Clip, Timed, find_clips, stream
from pred_core.bag.reader import open_bag
from pred_core.bag.wire import (
    GRIPPER_CLOSED,
    GRIPPER_POSE,
    TRACKER_POINTS,
    TYPES,
    bare_topic,
    camera_topics,
    decode,
    stamp_of,
)
from pred_core.bag.writer import BagWriter
from pred_core.config import to_mapping
from pred_core.errors import BagError, DatasetError, PredError, nearest
from pred_core.track.camera import Camera
from pred_core.track.settings import TrackerSettings, make_tracker, parse_cameras
from pred_core.types import ObjectInfo

WAITING = 8  # pictures of a camera that wait for their partner of the same stamp
Progress = Callable[[int, int, str], None]  # pictures of the first camera done, of how many, in which bag
_COLOR = (images.COLOR, images.COLOR_COMPRESSED)
_DEPTH = (images.DEPTH, images.DEPTH_COMPRESSED)


@dataclass
class BagCount:
    """What became of one bag's pictures."""

    name: str
    instants: int = 0  # of pictures, while the gripper was measured
    found: int = 0  # of these, with particles
    refused: Counter[str] = field(default_factory=Counter)  # why -> pictures that could not be used


def camera_names(clip: Clip) -> list[str]:
    """Prefixes of the cameras in a bag."""
    return sorted({camera for camera, _ in camera_topics(clip.cameras).values()})


def track_bags(
    clips: list[Clip], settings: TrackerSettings, root: Path, progress: Progress
) -> tuple[list[BagCount], float]:
    """Write `root/NAME.mcap` for every bag: its gripper topics, and `tracker/points` in place of the pictures.

    What an earlier, interrupted call with the same bags and settings has finished is kept, and not in the counts.
    Returns counts and the rate [Hz] of the tracks. Raises: PredError, DatasetError if `root` holds something else.
    """
    names = [clip.name for clip in clips]
    if len(set(names)) < len(names):
        raise DatasetError("two bags have the same name", got=", ".join(names), allowed="names of their own")
    digest = hashlib.sha256("".join(file_sha256(clip.path) for clip in clips).encode()).hexdigest()
    claim_folder(root, {"bags": digest, "format": 1, **to_mapping(settings)})
    counts, periods, total, before = [], [], sum(clip.frames for clip in clips), 0
    for clip in clips:
        path = root / f"{clip.name}.mcap"
        if not path.exists():
            show = functools.partial(_show, progress, before, total, clip.name)
            counts.append(_Tracking(clip, settings, show).write(path))
        before += clip.frames
        progress(before, total, clip.name)
        periods.append(median_period(read_episode(path).stamps))
    return counts, round(1e9 / float(np.median(periods)), 3)


def track_dataset(
    source: Path,
    settings: TrackerSettings,
    root: Path,
    name: str,
    progress: Progress,
    held: Mapping[int, int] | None = None,
) -> tuple[Dataset, list[BagCount]]:
    """Track a bag, or every bag of a data set, into the data set `root` (`track_bags`).

    A data set keeps its object, splits, `held` and facts; of a single bag the object is called `name`.
    held: particle id -> gripper index, in place of the source's.
    Raises: PredError for a bag without usable pictures, or where the object is not found or long out of sight.
    """
    clips = find_clips(source, points=False)
    said = held or {}
    for clip in clips:
        _check_grippers(clip, said)
    counts, rate = track_bags(clips, settings, root, progress)
    if said:
        for clip in clips:
            read_episode(root / f"{clip.name}.mcap", held=said)  # whether its particles are there
    known = load_dataset(source) if (source / FILE).is_file() else None
    theirs = [e.held for e in known.entries] if known is not None and held is None else [None] * len(clips)
    entries = [
        EpisodeEntry(f"{clip.name}.mcap", clip.split, clip.recording, own)
        for clip, own in zip(clips, theirs, strict=True)
    ]
    if known is None:
        info = ObjectInfo(name, settings.kind)
        return write_dataset(root, object=info, rate=rate, entries=entries, held=held), counts
    made = write_dataset(
        root, object=known.object, rate=rate, entries=entries, gravity=known.gravity, sigma=known.sigma,
        held=known.held if held is None else held, known=known.known,
    )  # fmt: skip
    return made, counts


def _check_grippers(clip: Clip, held: Mapping[int, int]) -> None:
    """Raises: BagError if particles are said to be in a gripper that the bag does not have."""
    if not held:
        return
    first = next(iter(open_bag(clip.path).read_messages((GRIPPER_POSE,))))
    count, most = len(read_gripper_pose(first.decode(), first.where).position), max(held.values())
    if most >= count:
        raise BagError(
            f"{clip.path.name}: held names gripper {most}", got=f"{count} grippers", allowed=f"0 to {count - 1}"
        )


def _show(progress: Progress, before: int, total: int, name: str, shown: int) -> None:
    progress(before + shown, total, name)


class _Tracking:
    """One bag through one tracker."""

    def __init__(self, clip: Clip, settings: TrackerSettings, progress: Callable[[int], None]):
        self._clip, self._progress = clip, progress
        self._names = [bare_topic(name) for name in parse_cameras(settings.cameras)]
        self._tracker = make_tracker(replace(settings, cameras=" ".join(self._names)))
        self._patience = round(settings.patience * 1e9)  # [ns]
        self._topics = camera_topics(clip.cameras)
        self._types = {topic: info.type for topic, info in open_bag(clip.path).topics.items()}
        for missing in set(self._names) - set(camera_names(clip)):
            next_step = nearest(missing, camera_names(clip))
            raise BagError(f"{clip.path.name}: no camera '{missing}' in it", next_step=next_step)
        self._cameras = {name: Camera(name) for name in self._names}
        self._waiting: dict[tuple[str, int], Any] = {}  # (camera, stamp) -> colour or depth without its partner
        self._group: dict[str, int] = {}  # camera -> stamp of its picture in the tracker
        self._closed: NDArray[np.bool_] | None = None
        self._gripped = False  # a gripper pose came, and whether it is closed is known
        self._points: list[PointFrame] = []
        self._shown = 0  # pictures of the first camera
        self._count = BagCount(clip.name)

    def write(self, path: Path) -> BagCount:
        """Track the whole bag, write the new one, and read it as whoever will use it. Raises: PredError."""
        bag = self._clip.path.name
        with BagWriter(path) as writer:
            for timed in stream(self._clip):
                if self._group and timed.stamp > min(self._group.values()) + self._patience:
                    self._step()
                if timed.topic in (GRIPPER_POSE, GRIPPER_CLOSED):
                    writer.write_raw(timed.topic, TYPES[timed.topic], timed.data, timed.stamp)
                    self._grip(timed)
                else:
                    self._camera(timed)
            self._step()
            for name, _ in self._waiting:
                self._without_partner(name)
            for frame in self._points:
                writer.write(TRACKER_POINTS, make_tracker_points(frame), frame.stamp)
            if not self._points:
                why = "; ".join(f"{line} ({n} times)" for line, n in self._count.refused.most_common(2))
                raise BagError(
                    f"{bag}: the {self._tracker.config.kind} was never found in {self._count.instants} instants",
                    got=why or None,
                    next_step="Check workspace, table, arm and camera poses",
                )
        try:
            read_episode(path)
        except PredError as error:
            path.unlink()
            raise BagError(
                f"{bag}: its tracks make no episode, {error}",
                got=f"particles in {self._count.found} of {self._count.instants} instants",
                next_step="Check workspace, table and arm, or record again",
            ) from error
        return self._count

    def _grip(self, timed: Timed) -> None:
        where = f"{self._clip.path.name}: {timed.topic}"
        message = decode(timed.data, TYPES[timed.topic], where)
        if timed.topic == GRIPPER_CLOSED:
            self._closed = read_gripper_closed(message, where)
        elif self._closed is not None:
            pose = read_gripper_pose(message, where)
            self._tracker.add_grip(pose.stamp, pose.position, pose.rotation, self._closed)
            self._gripped = True

    def _camera(self, timed: Timed) -> None:
        name, below = self._topics[timed.topic]
        raw = images.raw_topic(timed.topic)
        if name not in self._cameras or (raw != timed.topic and raw in self._types):  # a bag may have both
            return
        camera = self._cameras[name]
        message = decode(timed.data, self._types[timed.topic], f"{self._clip.path.name}: {timed.topic}")
        if below == images.INFO:
            camera.add_info(message)
        elif below == images.POSE:
            camera.add_pose(message)
        elif below in (*_COLOR, *_DEPTH):
            self._shown += name == self._names[0] and below in _COLOR
            self._pair(name, below in _COLOR, message)

    def _pair(self, name: str, is_color: bool, message: Any) -> None:
        key = (name, stamp_of(message))
        if key not in self._waiting:
            self._waiting[key] = (is_color, message)
            own = sorted(stamp for camera, stamp in self._waiting if camera == name)
            for stamp in own[:-WAITING]:
                del self._waiting[name, stamp]
                self._without_partner(name)
            return
        was_color, other = self._waiting.pop(key)
        if was_color == is_color:
            raise BagError(f"{self._clip.path.name}: two pictures of '{name}' with one stamp", got=f"{key[1]} ns")
        if not self._gripped:  # which end of a line is the first is not known yet, and such a frame could not be used
            return
        if name in self._group:
            self._step()
        color, depth = (message, other) if is_color else (other, message)
        try:
            self._tracker.add_frame(name, self._cameras[name].picture(color, depth))
        except PredError as error:
            self._count.refused[str(error)] += 1
            return
        self._group[name] = key[1]

    def _without_partner(self, name: str) -> None:
        self._count.refused[f"{name}: colour and depth of different stamps"] += 1

    def _step(self) -> None:
        if not self._group:
            return
        self._group = {}
        estimate = self._tracker.step()
        self._count.instants += 1
        if self._shown < self._clip.frames:  # the end is said once it is written
            self._progress(self._shown)
        if estimate is not None and estimate.status == "tracking":
            tracks = estimate.tracks
            self._points.append(PointFrame(int(tracks.stamp), tracks.position, tracks.id, tracks.confidence, None))
            self._count.found += 1

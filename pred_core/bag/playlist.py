"""Which bags a replay plays, and their messages as one checked stream in the order of their stamps."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pred_core.bag.clouds import read_tracker_points
from pred_core.bag.dataset import FILE, EpisodeEntry, load_dataset
from pred_core.bag.episode import check_forward
from pred_core.bag.grippers import read_gripper_closed, read_gripper_pose
from pred_core.bag.images import COLOR
from pred_core.bag.reader import BagMessage, BagReader, open_bag
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, REQUIRED, TRACKER_POINTS, camera_topics, stamp_of
from pred_core.errors import BagError, DatasetError, nearest

WINDOW = 512  # messages held back to bring topics into the order of their stamps
# Of messages with one stamp the flags go first: they have no stamp and hold for the poses that follow.
# Pictures go last.
_ORDER = {GRIPPER_CLOSED: 0, GRIPPER_POSE: 1, TRACKER_POINTS: 2}
_PICTURE = 3


@dataclass(frozen=True)
class Clip:
    """One bag to play."""

    path: Path
    name: str
    begin: int  # [ns] stamp of the first tracker/points; in a bag without, of the first picture
    frames: int  # number of them
    split: str = ""
    recording: int = -1
    kind: str = ""  # line | sheet | volume | mixed, if known
    topics: tuple[str, ...] = REQUIRED  # what is played

    @property
    def cameras(self) -> tuple[str, ...]:
        """Topics of cameras."""
        return tuple(t for t in self.topics if t not in _ORDER)


@dataclass(frozen=True, order=True)
class Timed:
    """One message at its capture time."""

    stamp: int  # [ns] header stamp; for flags, which have none, that of their log time
    order: int
    number: int
    topic: str = field(compare=False)
    data: bytes = field(compare=False)  # CDR


def find_clips(path: Path, split: str = "all", names: tuple[str, ...] = (), points: bool = True) -> list[Clip]:
    """The bags of a data set folder (or the one bag `path`), in order. points False: tracker/points is left out.

    Raises: BagError, DatasetError if anything is missing, damaged or unknown.
    """
    if not (path / FILE).is_file():
        if names:
            raise DatasetError(f"{path}: a single bag has no episode names", got=", ".join(names))
        return [_clip(path, EpisodeEntry(path.name, "test"), "", points)]
    dataset = load_dataset(path)
    entries = dataset.select(None if split == "all" else split)
    known = {Path(e.bag).stem: e for e in entries}
    for name in names:
        if name not in known:
            raise DatasetError(f"{path}: no episode '{name}' in split {split}", next_step=nearest(name, known))
    chosen = [known[n] for n in names] if names else list(entries)
    return [_clip(dataset.root / e.bag, e, dataset.object.kind, points) for e in chosen]


def _clip(path: Path, entry: EpisodeEntry, kind: str, points: bool) -> Clip:
    reader = open_bag(path)
    if reader.damage is not None:
        raise BagError(f"{path.name}: truncated or damaged bag, {reader.damage}", next_step="Record the episode again")
    cameras = tuple(camera_topics(reader.topics))
    pictures = [t for t in cameras if f"/{COLOR}" in t]
    if not points and not pictures:
        had = ", ".join(reader.topics) or "nothing"
        raise BagError(f"{path.name}: no pictures of cameras", got=had, next_step="Record color/ and depth/ topics")
    points = points and (TRACKER_POINTS in reader.topics or not pictures)
    needed = REQUIRED if points else tuple(t for t in REQUIRED if t != TRACKER_POINTS)
    reader.require(needed)
    leading = TRACKER_POINTS if points else pictures[0]
    begin, frames = _first_stamp(reader, leading), reader.topics[leading].count
    name = Path(entry.bag).stem
    return Clip(reader.path, name, begin, frames, entry.split, entry.recording, kind, (*needed, *cameras))


def _first_stamp(reader: BagReader, topic: str) -> int:
    first = next(iter(reader.read_messages((topic,))))
    if topic == TRACKER_POINTS:
        return read_tracker_points(first.decode(), first.where).stamp
    return stamp_of(first.decode())


def stream(clip: Clip) -> Iterator[Timed]:
    """The messages of the clip's topics in the order of their stamps, each checked against the bag contract.

    Memory: WINDOW messages. Raises: BagError at the first message that breaks the contract.
    """
    waiting: list[Timed] = []
    newest: dict[str, int] = {}
    delay = 0  # [ns] log time behind the stamp, from the last stamped message
    for number, message in enumerate(open_bag(clip.path).read_messages(clip.topics)):
        stamp = _checked_stamp(message)
        if stamp is None:
            stamp = message.log_time - delay
        else:
            delay = message.log_time - stamp
            check_forward([newest[message.topic]] if message.topic in newest else [], stamp, message.where)
            newest[message.topic] = stamp
        heapq.heappush(waiting, Timed(stamp, _ORDER.get(message.topic, _PICTURE), number, message.topic, message.data))
        if len(waiting) > WINDOW:
            yield heapq.heappop(waiting)
    while waiting:
        yield heapq.heappop(waiting)


def _checked_stamp(message: BagMessage) -> int | None:
    """Header stamp [ns]; None for flags, which have no header."""
    decoded = message.decode()
    if message.topic == TRACKER_POINTS:
        return read_tracker_points(decoded, message.where).stamp
    if message.topic == GRIPPER_POSE:
        return read_gripper_pose(decoded, message.where).stamp
    if message.topic == GRIPPER_CLOSED:
        read_gripper_closed(decoded, message.where)
        return None
    return stamp_of(decoded)  # of a camera; its reader checks the rest

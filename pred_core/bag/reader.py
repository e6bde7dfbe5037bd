"""A streaming reader of MCAP bags: one chunk in memory, whatever the length of the bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from pred_core.bag import mcap_records as mcap
from pred_core.bag.wire import REQUIRED, TYPES, bare_topic, camera_topics, decode
from pred_core.errors import BagError, nearest


@dataclass(frozen=True)
class BagMessage:
    """One message, not decoded yet."""

    topic: str  # without leading slash
    type: str
    log_time: int  # [ns] when it was recorded; the header stamp is the truth about time
    data: bytes  # CDR
    where: str  # bag and topic, for error lines

    def decode(self) -> Any:
        """The message object. Raises: BagError if the bytes are damaged."""
        return decode(self.data, self.type, self.where)


@dataclass(frozen=True)
class TopicInfo:
    """What a bag holds of one topic."""

    topic: str
    type: str
    count: int


class BagReader:
    """What an MCAP bag holds, and its messages as a stream in file order.

    `topics`: name without leading slash -> TopicInfo; `message_count`; `log_begin`, `log_end` [ns];
    `damage`: None, or the line that says from where on the file cannot be read. Use `open_bag`.
    """

    def __init__(self, path: Path, topics: dict[str, TopicInfo], log_span: tuple[int, int], damage: str | None):
        self.path = path
        self.topics = topics
        self.log_begin, self.log_end = log_span
        self.damage = damage

    @property
    def message_count(self) -> int:
        """Number of readable messages on all topics."""
        return sum(info.count for info in self.topics.values())

    @property
    def duration(self) -> float:
        """[s] from the first to the last log time."""
        return (self.log_end - self.log_begin) * 1e-9

    @property
    def cameras(self) -> tuple[str, ...]:
        """Prefixes of the cameras in the bag."""
        return tuple(sorted({camera for camera, _ in camera_topics(self.topics).values()}))

    def require(self, topics: Iterable[str] = REQUIRED) -> None:
        """Raise BagError unless every topic is there, with its type and at least one message."""
        for topic in topics:
            if topic not in self.topics and self.damage:
                raise self._damaged(self.damage)
            if topic not in self.topics:
                held = ", ".join(sorted(self.topics)) or "no topics"
                raise BagError(
                    f"{self.path.name}: no topic '{topic}'; the bag has {held}",
                    next_step=f"Record or remap it ({nearest(topic, self.topics)})" if self.topics else "Record it",
                )
            info = self.topics[topic]
            if topic in TYPES and info.type != TYPES[topic]:
                raise BagError(f"{self.path.name}: wrong type of '{topic}'", got=info.type, allowed=TYPES[topic])
            if info.count == 0:
                raise BagError(f"{self.path.name}: topic '{topic}' has no messages", next_step="Record it again")

    def read_messages(self, topics: Iterable[str] | None = None, *, partial: bool = False) -> Iterator[BagMessage]:
        """Messages of `topics` (None: all) in file order, one chunk in memory at a time.

        Raises: BagError where the file is damaged, after the messages before it; with `partial` the
        stream just ends there (`damage` says why).
        """
        wanted = None if topics is None else {bare_topic(t) for t in topics}
        try:
            with self.path.open("rb") as stream:
                _check_start(stream, self.path)
                for message, topic, type_name in _messages(stream):
                    if wanted is None or topic in wanted:
                        where = f"{self.path.name}: {topic}"
                        yield BagMessage(topic, type_name, message.log_time, message.data, where)
        except mcap.Damage as damage:
            self.damage = str(damage)
            if not partial:
                raise self._damaged(str(damage)) from damage

    def _damaged(self, damage: str) -> BagError:
        return BagError(
            f"{self.path.name}: truncated or damaged bag, {damage}",
            next_step="Record the episode again, or take it out of the data set",
        )


def open_bag(path: Path | str) -> BagReader:
    """Open an MCAP file, or the folder with one MCAP file that `ros2 bag record` writes.

    The file is walked through once to count its messages (one chunk in memory). A truncated bag opens:
    its `damage` is set and its counts are those of the readable part. Raises: BagError if it is not a bag.
    """
    path = _bag_file(Path(path))
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    begin, end = 2**63, 0
    damage = None
    try:
        with path.open("rb") as stream:
            _check_start(stream, path)
            try:
                for message, topic, type_name in _messages(stream, types):
                    if types.setdefault(topic, type_name) != type_name:
                        raise BagError(f"{path.name}: '{topic}' has two types", got=f"{types[topic]} and {type_name}")
                    counts[topic] += 1
                    begin, end = min(begin, message.log_time), max(end, message.log_time)
            except mcap.Damage as error:
                damage = str(error)
    except OSError as error:
        raise BagError(f"{path}: cannot be read", got=error) from error
    topics = {t: TopicInfo(t, types[t], counts[t]) for t in sorted(types)}
    return BagReader(path, topics, (min(begin, end), end), damage)


def _bag_file(path: Path) -> Path:
    if path.is_dir():
        files = sorted(path.glob("*.mcap"))
        if len(files) != 1:
            raise BagError(
                f"{path}: not a bag",
                got=f"a folder with {len(files)} .mcap files",
                allowed="an .mcap file, or a folder with one",
                next_step="Give one of its files" if files else "Record with 'ros2 bag record --storage mcap'",
            )
        return files[0]
    if not path.is_file():
        raise BagError(f"{path}: no such bag", next_step="Check the path")
    return path


def _check_start(stream: BinaryIO, path: Path) -> None:
    start = stream.read(len(mcap.MAGIC))
    if start != mcap.MAGIC:
        raise BagError(
            f"{path.name}: not a bag",
            got=f"a file that begins with {start!r}" if start else "an empty file",
            allowed="an MCAP file",
            next_step="Convert other bags with 'ros2 bag convert'",
        )


def _messages(stream: BinaryIO, types: dict[str, str] | None = None) -> Iterator[tuple[mcap.Message, str, str]]:
    """(message, topic, type) of every message; `types` collects channels, also those without messages."""
    schemas: dict[int, mcap.Schema] = {}
    channels: dict[int, tuple[str, str]] = {}

    def handle(opcode: int, content: bytes) -> tuple[mcap.Message, str, str] | None:
        if opcode == mcap.SCHEMA:
            schema = mcap.parse_schema(content)
            schemas[schema.id] = schema
        elif opcode == mcap.CHANNEL:
            channel = mcap.parse_channel(content)
            if channel.schema not in schemas:
                raise mcap.Damage(f"channel '{channel.topic}' has no schema")
            topic = bare_topic(channel.topic)
            if channel.encoding != "cdr":
                raise BagError(f"wrong encoding of '{topic}'", got=repr(channel.encoding), allowed="cdr (ROS 2)")
            channels[channel.id] = (topic, schemas[channel.schema].name)
            if types is not None:
                types.setdefault(topic, schemas[channel.schema].name)
        elif opcode == mcap.MESSAGE:
            message = mcap.parse_message(content)
            if message.channel not in channels:
                raise mcap.Damage(f"a message on channel {message.channel}, which is nowhere described")
            return message, *channels[message.channel]
        return None

    for opcode, content in mcap.records(stream):
        if opcode == mcap.CHUNK:
            for inner_opcode, inner in mcap.chunk_records(content):
                if (found := handle(inner_opcode, inner)) is not None:
                    yield found
        elif (found := handle(opcode, content)) is not None:
            yield found

"""A streaming writer of MCAP bags that `ros2 bag play` plays and Foxglove opens."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from pred_core.bag.wire import TYPES, bare_topic, encode, typestore
from pred_core.errors import BagError

CHUNK_SIZE = 1 << 16  # [bytes] before compression; what reader and writer hold, and what a cut file loses
_FOREVER = {"sec": 9223372036, "nsec": 854775807}  # how rosbag2 writes an infinite duration


class BagWriter:
    """Writes messages to `path` as they come; the file appears under its name only when it is whole.

    Use as a context manager. ROS 2 profile, CDR messages, ros2msg schemas, chunks compressed with zstd.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self._partial = self.path.with_name(f".{self.path.name}.part")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def __enter__(self) -> BagWriter:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self._partial.open("wb")
        except OSError as error:
            raise BagError(f"{self.path}: cannot be written", got=error) from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="pred_core")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        if kind is not None:
            self._stream.close()
            self._partial.unlink(missing_ok=True)
            return
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        os.replace(self._partial, self.path)

    def write(self, topic: str, message: Any, log_time: int) -> None:
        """Append a message object, recorded at `log_time` [ns]."""
        self.write_raw(topic, message.__msgtype__, encode(message), log_time)

    def write_raw(self, topic: str, type_name: str, data: bytes, log_time: int) -> None:
        """Append CDR bytes of a message type. Raises: BagError if the topic has another type on the wire."""
        wanted = TYPES.get(bare_topic(topic), type_name)
        if wanted != type_name:
            raise BagError(f"{self.path.name}: wrong type for '{topic}'", got=type_name, allowed=wanted)
        if topic not in self._channels:
            self._channels[topic] = self._register(topic, type_name)
        self._writer.add_message(self._channels[topic], log_time=log_time, data=data, publish_time=log_time)

    def _register(self, topic: str, type_name: str) -> int:
        store = typestore()
        if type_name not in store.types:
            raise BagError(f"{self.path.name}: unknown message type '{type_name}'", allowed="common_interfaces")
        if type_name not in self._schemas:
            text, _ = store.generate_msgdef(type_name, ros_version=2)
            self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text.encode())
        metadata = {"offered_qos_profiles": _RELIABLE, "topic_type_hash": store.hash_rihs01(type_name)}
        return self._writer.register_channel(topic, "cdr", self._schemas[type_name], metadata)


_RELIABLE = yaml.safe_dump(
    [
        {
            "history": "keep_last",
            "depth": 5,
            "reliability": "reliable",
            "durability": "volatile",
            "deadline": _FOREVER,
            "lifespan": _FOREVER,
            "liveliness": "automatic",
            "liveliness_lease_duration": _FOREVER,
            "avoid_ros_namespace_conventions": False,
        }
    ],
    sort_keys=False,
)

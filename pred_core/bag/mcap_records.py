"""MCAP records, read one after the other with every length checked, so that damage is an error, not a crash.

Format: MCAP specification, "Records" and "Chunk" (mcap.dev/spec). The reference library reads short
data in silence at the end of a cut file, which is why the framing is read here.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import lz4.frame
import zstandard

from pred_core.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END = 1, 2, 3, 4, 5, 6, 0x0B, 0x0F
LATEST_TIME = 1 << 62  # [ns] since 1970; differences of times below it fit 64 bits
LARGEST_RECORD = 1 << 30  # [bytes]; a longer one is a damaged length, or does not fit in memory


class Damage(BagError):
    """The file is not what its own lengths and checksums promise from here on."""


@dataclass(frozen=True)
class Schema:
    """A message definition."""

    id: int
    name: str  # the message type
    encoding: str


@dataclass(frozen=True)
class Channel:
    """A topic."""

    id: int
    schema: int
    topic: str
    encoding: str


@dataclass(frozen=True)
class Message:
    """Raw bytes of one message."""

    channel: int
    log_time: int  # [ns]
    publish_time: int  # [ns]
    data: bytes


class Fields:
    """Reads little-endian fields from a record and refuses to read past its end."""

    def __init__(self, data: bytes):
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._at

    def take(self, count: int) -> bytes:
        """The next `count` bytes. Raises: Damage."""
        if count > self.left:
            raise Damage(f"a record ends {count - self.left} bytes early")
        self._at += count
        return self._data[self._at - count : self._at]

    def unpack(self, layout: str) -> tuple[int, ...]:
        """Fields of a `struct` layout."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def text(self) -> str:
        """A length-prefixed string."""
        (length,) = self.unpack("I")
        try:
            return self.take(length).decode("utf-8")
        except UnicodeDecodeError as error:
            raise Damage("a name in the file is not text") from error


def records(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of each record up to and including the data end or footer.

    Raises: Damage at the first place that cannot be read. Memory: one record.
    """
    size = os.fstat(stream.fileno()).st_size
    while True:
        begin = stream.tell()
        head = stream.read(9)
        if len(head) < 9:
            raise Damage(f"the file ends at byte {size} without its end mark")
        opcode, length = struct.unpack("<BQ", head)
        if opcode == 0:
            raise Damage(f"no record begins at byte {begin}")
        if length > size - begin - 9:
            raise Damage(f"the record at byte {begin} is cut off: it needs {length} bytes, {size - begin - 9} are left")
        if length > LARGEST_RECORD:
            raise Damage(f"the record at byte {begin} says it holds {length} bytes; at most {LARGEST_RECORD} are read")
        yield opcode, stream.read(length)
        if opcode in (DATA_END, FOOTER):
            return


def chunk_records(content: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of the records inside a chunk, after its checksum has been verified."""
    fields = Fields(content)
    _, _, size, crc = fields.unpack("QQQI")
    compression = fields.text()
    (stored,) = fields.unpack("Q")
    data = _decompress(fields.take(stored), compression, size)
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise Damage("a chunk does not match its checksum")
    inner = Fields(data)
    while inner.left:
        opcode, length = inner.unpack("BQ")
        yield opcode, inner.take(length)


def parse_schema(content: bytes) -> Schema:
    """A schema record."""
    fields = Fields(content)
    (number,) = fields.unpack("H")
    return Schema(number, fields.text(), fields.text())


def parse_channel(content: bytes) -> Channel:
    """A channel record."""
    fields = Fields(content)
    number, schema = fields.unpack("HH")
    return Channel(number, schema, fields.text(), fields.text())


def parse_message(content: bytes) -> Message:
    """A message record."""
    fields = Fields(content)
    channel, _, log_time, publish_time = fields.unpack("HIQQ")
    if log_time > LATEST_TIME:
        raise Damage(f"a message was recorded at {log_time} ns, after the year 2116")
    return Message(channel, log_time, publish_time, fields.take(fields.left))


def _decompress(data: bytes, compression: str, size: int) -> bytes:
    """At most `size` + 1 bytes are unpacked, whatever the compressed data claim."""
    if size > LARGEST_RECORD:
        raise Damage(f"a chunk says it unpacks to {size} bytes; at most {LARGEST_RECORD} are read")
    try:
        if compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data)) as reader:
                return _read_up_to(reader, size + 1)
        if compression == "lz4":
            with lz4.frame.open(io.BytesIO(data)) as reader:
                return _read_up_to(reader, size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError, MemoryError) as error:
        raise Damage("a chunk cannot be unpacked", got=error) from error
    if compression:
        raise Damage(f"unknown compression '{compression}'", allowed="zstd, lz4 or none")
    return data


def _read_up_to(reader: BinaryIO | zstandard.ZstdDecompressionReader, limit: int) -> bytes:
    parts, left = [], limit
    while left and (part := reader.read(min(left, 1 << 20))):
        parts.append(part)
        left -= len(part)
    return b"".join(parts)

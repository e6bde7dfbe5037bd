"""A damaged bag gives a readable prefix or a BagError, never another exception."""

import functools
import tempfile
from pathlib import Path

from bag_examples import line_bag, line_episode
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from pred_core.bag.episode import read_episode
from pred_core.bag.reader import open_bag
from pred_core.bag.summary import summarize_bag
from pred_core.bag.wire import typestore
from pred_core.errors import BagError

FRAMES = 12


@functools.cache
def _bag(chunked: bool) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = line_bag(Path(folder) / "a.mcap", FRAMES)
        if chunked:
            return path.read_bytes()
        plain = Path(folder) / "plain.mcap"  # no chunks and no checksums: damage reaches the message decoders
        with plain.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.NONE, use_chunking=False)
            writer.start("ros2")
            channels: dict[str, int] = {}
            for message in open_bag(path).read_messages():
                if message.topic not in channels:
                    text, _ = typestore().generate_msgdef(message.type, ros_version=2)
                    schema = writer.register_schema(message.type, "ros2msg", text.encode())
                    channels[message.topic] = writer.register_channel(message.topic, "cdr", schema)
                writer.add_message(channels[message.topic], message.log_time, message.data, message.log_time)
            writer.finish()
        return plain.read_bytes()


def _survives(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fuzzed.mcap"
        path.write_bytes(data)
        for use in (read_episode, summarize_bag):
            try:
                use(path)
            except BagError as error:
                assert "\n" not in str(error)
        try:
            reader = open_bag(path)
        except BagError:
            return
        assert len(list(reader.read_messages(partial=True))) == reader.message_count <= 3 * FRAMES


@settings(max_examples=300, deadline=None)
@given(st.booleans(), st.floats(0.0, 1.0))
def test_truncated_anywhere(chunked: bool, share: float) -> None:
    data = _bag(chunked)
    _survives(data[: int(share * len(data))])


@settings(max_examples=300, deadline=None)
@given(st.booleans(), st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 7)), min_size=1, max_size=6))
def test_flipped_bits(chunked: bool, flips: list[tuple[float, int]]) -> None:
    data = bytearray(_bag(chunked))
    for share, bit in flips:
        data[min(int(share * len(data)), len(data) - 1)] ^= 1 << bit
    _survives(bytes(data))


@settings(max_examples=300, deadline=None)
@given(st.floats(0.0, 1.0), st.binary(min_size=1, max_size=24))
def test_overwritten_bytes(share: float, junk: bytes) -> None:
    data = bytearray(_bag(False))
    at = int(share * max(len(data) - len(junk), 0))
    data[at : at + len(junk)] = junk
    _survives(bytes(data))


def test_the_undamaged_bags_are_whole() -> None:
    for chunked in (True, False):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.mcap"
            path.write_bytes(_bag(chunked))
            assert (read_episode(path).position == line_episode(FRAMES).position).all()

"""Reading and writing stream: memory does not grow with the bag's length."""

import tracemalloc
from pathlib import Path

import numpy as np

from pred_core.bag.clouds import PointFrame, make_tracker_points
from pred_core.bag.reader import open_bag
from pred_core.bag.wire import TRACKER_POINTS
from pred_core.bag.writer import BagWriter

POINTS = 500  # 10 kB a message
MEGABYTE = 1 << 20


def _peak_of_writing(path: Path, messages: int) -> int:
    generator = np.random.default_rng(0)
    ids, seen = np.arange(POINTS, dtype=np.uint32), np.ones(POINTS, np.float32)
    tracemalloc.start()
    with BagWriter(path) as writer:
        for t in range(messages):
            points = PointFrame(t * 1000, generator.random((POINTS, 3)), ids, seen, None)
            writer.write(TRACKER_POINTS, make_tracker_points(points), t * 1000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def _peak_of_reading(path: Path) -> tuple[int, int]:
    tracemalloc.start()
    count = sum(1 for message in open_bag(path).read_messages() if message.decode() is not None)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak, count


def test_memory_is_that_of_a_chunk_whatever_the_length(tmp_path: Path) -> None:
    """8 times the messages (2.5 MB against 20 MB of data) may cost no more than a few index entries."""
    _peak_of_writing(tmp_path / "warm.mcap", 10)  # the message definitions are loaded once
    written = [_peak_of_writing(tmp_path / f"{n}.mcap", n) for n in (250, 2000)]
    read = [_peak_of_reading(tmp_path / f"{n}.mcap") for n in (250, 2000)]
    assert [count for _, count in read] == [250, 2000]
    # The writer's index has about 0.3 kB a chunk of 64 kB: 0.1 MB for the longer bag.
    assert written[1] - written[0] < 0.5 * MEGABYTE
    assert read[1][0] - read[0][0] < 0.1 * MEGABYTE
    assert read[1][0] < 2 * MEGABYTE < 2000 * POINTS * 20

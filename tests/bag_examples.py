"""A small bag whose every number is known, and ways to spoil it, shared by the bag tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pred_core.bag.episode import write_episode
from pred_core.bag.reader import open_bag
from pred_core.bag.wire import TRACKER_POINTS
from pred_core.bag.writer import BagWriter
from pred_core.types import Episode, Grip, ObjectInfo, Tracks

PERIOD = 10_000_000  # [ns] 100 Hz
START = 5_000_000_000  # [ns]


def line_episode(frames: int = 20, particles: int = 5) -> Episode:
    """Particles 0.1 m apart along x that move at 1 m/s along y; gripper 0 holds the first, gripper 1 is open."""
    stamps = START + np.arange(frames, dtype=np.int64) * PERIOD
    time = np.arange(frames) * PERIOD * 1e-9
    position = np.zeros((frames, particles, 3))
    position[..., 0] = 0.1 * np.arange(particles)
    position[..., 1] = time[:, None]
    position[..., 2] = 0.5
    position = position.astype(np.float32).astype(np.float64)
    visible = np.ones((frames, particles), bool)
    grips = Grip(
        torch.as_tensor(position[:, [0, -1]], dtype=torch.float32),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(frames, 2, 1),
        torch.tensor([True, False]).repeat(frames, 1),
    )
    held = np.full(particles, -1, np.int32)
    held[0] = 0
    ids = 10 + 3 * np.arange(particles, dtype=np.uint32)
    tracks = Tracks(stamps, position, ids, visible, visible.astype(np.float32))
    return Episode("line", ObjectInfo("line", "line"), stamps, tracks, grips, held, "test", 0)


def line_bag(path: Path, frames: int = 20) -> Path:
    """`line_episode` as a bag."""
    write_episode(path, line_episode(frames))
    return path


Edit = Callable[[str, Any, int], Any]  # topic, message, its number on the topic -> message, or None to drop it


def edited_bag(path: Path, edit: Edit, frames: int = 20) -> Path:
    """`line_bag` with every message passed through `edit`; log times stay."""
    original = line_bag(path.with_name("original.mcap"), frames)
    seen: dict[str, int] = {}
    with BagWriter(path) as writer:
        for message in open_bag(original).read_messages():
            number = seen.get(message.topic, 0)
            seen[message.topic] = number + 1
            changed = edit(message.topic, message.decode(), number)
            if changed is not None:
                writer.write(message.topic, changed, message.log_time)
    return path


def points_edited(path: Path, change: Callable[[np.ndarray], None], at: int = 7) -> Path:
    """`line_bag` whose tracker message number `at` has its structured array changed in place."""

    def edit(topic: str, message: Any, number: int) -> Any:
        if topic == TRACKER_POINTS and number == at:
            dtype = np.dtype([(n, "<f4" if n != "id" else "<u4") for n in ("x", "y", "z", "id", "confidence")])
            cloud = np.frombuffer(message.data.tobytes(), dtype).copy()
            change(cloud)
            message.data = np.frombuffer(cloud.tobytes(), np.uint8)
        return message

    return edited_bag(path, edit)

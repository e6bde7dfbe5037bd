"""One bag <-> one Episode: tracks and gripper poses on a common clock."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.align import align_flags, align_poses, median_period
from pred_core.bag.clouds import PointFrame, make_tracker_points, read_tracker_points
from pred_core.bag.grippers import (
    PoseFrame,
    make_gripper_closed,
    make_gripper_pose,
    read_gripper_closed,
    read_gripper_pose,
)
from pred_core.bag.reader import BagReader, open_bag
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, REQUIRED, TRACKER_POINTS
from pred_core.bag.writer import BagWriter
from pred_core.errors import BagError
from pred_core.types import STANDARD_GRAVITY, Episode, Grip, ObjectInfo, Tracks

GRASP_RADIUS = 0.02  # [m] a closed gripper holds the particles within it, where the data set does not say
LONGEST_GAP = 1.0  # [s] of lost tracker frames that become unmeasured frames


@dataclass
class RawEpisode:
    """The three required topics of a bag, each on its own stamps."""

    points: list[PointFrame] = field(default_factory=list)
    poses: list[PoseFrame] = field(default_factory=list)
    pose_log: list[int] = field(default_factory=list)  # [ns]
    closed: list[NDArray[np.bool_]] = field(default_factory=list)
    closed_log: list[int] = field(default_factory=list)  # [ns]


def read_episode(
    path: Path | str,
    *,
    name: str | None = None,
    object: ObjectInfo | None = None,
    held: Mapping[int, int] | None = None,
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
    split: str = "test",
    recording: int = 0,
    rate: float | None = None,
) -> Episode:
    """The episode of a bag.

    held: particle id -> gripper index; None: the particles within GRASP_RADIUS of a closed gripper at the
    first frame. rate [Hz]: checked against the stamps if given. Particles are ordered by id. A frame
    the tracker lost inside the episode becomes a frame in which nothing is measured (NaN, invisible), so that
    frames are one period apart. Raises: BagError for everything the bag contract (bags/README.md) forbids.
    """
    reader = open_bag(path)
    raw = read_raw(reader)
    bag = reader.path.name
    if len(raw.points) < 2:
        raise BagError(f"{bag}: an episode needs at least 2 messages on {TRACKER_POINTS}", got=len(raw.points))
    stamps, source = regular_stamps(np.array([f.stamp for f in raw.points], np.int64), rate, bag)
    frames = [None if k < 0 else raw.points[k] for k in source.tolist()]
    tracks = _tracks(stamps, frames, bag)
    grips = _grips(stamps, raw, bag)
    return Episode(
        name=name or reader.path.stem,
        object=object or ObjectInfo(),
        stamps=stamps,
        tracks=tracks,
        grips=grips,
        held=_held(tracks, grips, held, bag),
        split=split,
        recording=recording,
        gravity=gravity,
        cameras=reader.cameras,
        source=reader.path,
    )


def read_raw(reader: BagReader, *, partial: bool = False) -> RawEpisode:
    """Every message of the required topics, checked one by one, time checked to run forwards."""
    reader.require(REQUIRED)
    raw = RawEpisode()
    for message in reader.read_messages(REQUIRED, partial=partial):
        if message.topic == TRACKER_POINTS:
            frame = read_tracker_points(message.decode(), message.where)
            check_forward([raw.points[-1].stamp] if raw.points else [], frame.stamp, message.where)
            raw.points.append(frame)
        elif message.topic == GRIPPER_POSE:
            pose = read_gripper_pose(message.decode(), message.where)
            check_forward([raw.poses[-1].stamp] if raw.poses else [], pose.stamp, message.where)
            if raw.poses and len(pose.position) != len(raw.poses[0].position):
                raise BagError(
                    f"{message.where}: the number of grippers changes",
                    got=f"{len(raw.poses[0].position)}, then {len(pose.position)}",
                )
            raw.poses.append(pose)
            raw.pose_log.append(message.log_time)
        else:
            raw.closed.append(read_gripper_closed(message.decode(), message.where))
            raw.closed_log.append(message.log_time)
    return raw


def check_forward(before: list[int], stamp: int, where: str) -> None:
    """Raise BagError unless `stamp` [ns] comes after the one `before` it (an empty list: the first)."""
    if before and stamp <= before[0]:
        raise BagError(
            f"{where}: time runs backwards",
            got=f"header stamp {stamp * 1e-9:.6f} s after {before[0] * 1e-9:.6f} s",
            next_step="One episode a bag; do not record across a loop or a clock reset",
        )


def write_episode(path: Path | str, episode: Episode) -> None:
    """Write an episode as a bag. Hidden particles get confidence 0; the log time is the stamp."""
    tracks, grips = episode.tracks, episode.grips
    position, rotation = grips.position.double().numpy(), grips.rotation.double().numpy()
    closed = grips.closed.numpy()
    with BagWriter(path) as writer:
        for t, stamp in enumerate(episode.stamps.tolist()):
            color = None if tracks.color is None else (tracks.color[t] if tracks.color.ndim == 3 else tracks.color)
            confidence = np.where(tracks.visible[t], tracks.confidence[t], 0.0).astype(np.float32)
            frame = PointFrame(stamp, tracks.position[t], tracks.id, confidence, color)
            writer.write(TRACKER_POINTS, make_tracker_points(frame), stamp)
            writer.write(GRIPPER_POSE, make_gripper_pose(stamp, position[t], rotation[t]), stamp)
            writer.write(GRIPPER_CLOSED, make_gripper_closed(closed[t]), stamp)


def regular_stamps(
    measured: NDArray[np.int64], rate: float | None, bag: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Stamps (T,) [ns] with the lost frames filled in, and the message of each (T,), -1 where it was lost.

    measured (M,) [ns]: stamps of the messages. Raises: BagError for a wrong rate or too long a gap.
    """
    period = median_period(measured)
    if rate is not None and abs(period * 1e-9 * rate - 1.0) > 0.05:
        raise BagError(
            f"{bag}: {TRACKER_POINTS} does not come at the rate of dataset.yaml",
            got=f"{1e9 / period:.4g} Hz",
            allowed=f"{rate:g} Hz +- 5 %",
            next_step="Correct 'rate'",
        )
    stamps, source = array("q", [int(measured[0])]), array("q", [0])
    for number, stamp in enumerate(measured[1:].tolist(), start=1):
        gap = stamp - stamps[-1]
        lost = round(gap / period) - 1
        if lost > len(measured) or (lost > 0 and gap * 1e-9 > max(LONGEST_GAP, 3e-9 * period)):
            raise BagError(
                f"{bag}: {TRACKER_POINTS} has a gap of {gap * 1e-9:.3g} s at {stamps[-1] * 1e-9:.3f} s",
                allowed=f"{LONGEST_GAP:g} s, and no more frames lost than measured",
                next_step="Cut the bag into two episodes of one recording",
            )
        begin = stamps[-1]
        for k in range(1, lost + 1):
            stamps.append(begin + round(gap * k / (lost + 1)))
            source.append(-1)
        stamps.append(stamp)
        source.append(number)
    return np.array(stamps, np.int64), np.array(source, np.int64)


def flag_times(
    closed_log: NDArray[np.int64], pose_log: NDArray[np.int64], pose_stamps: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Times [ns] of the closed flags on the clock of the headers.

    The flags have no header. Their log times are moved by the delay between stamp and log of the poses.
    """
    return closed_log - round(float(np.median(pose_log - pose_stamps)))


def _tracks(stamps: NDArray[np.int64], frames: list[PointFrame | None], bag: str) -> Tracks:
    ids = np.unique(np.concatenate([f.id for f in frames if f is not None]))
    if not len(ids):
        raise BagError(f"{bag}: {TRACKER_POINTS} holds no particles in any message")
    shape = (len(stamps), len(ids))
    position = np.full((*shape, 3), np.nan)
    confidence = np.zeros(shape, np.float32)
    colored = all(f is None or f.color is not None for f in frames)
    color = np.zeros((*shape, 3), np.uint8) if colored else None
    for t, frame in enumerate(frames):
        if frame is None:
            continue
        columns = np.searchsorted(ids, frame.id)
        position[t, columns] = frame.position
        confidence[t, columns] = frame.confidence
        if color is not None and frame.color is not None:
            color[t, columns] = frame.color
    return Tracks(stamps, position, ids, confidence > 0, confidence, color)


def _grips(stamps: NDArray[np.int64], raw: RawEpisode, bag: str) -> Grip:
    pose_stamps = np.array([p.stamp for p in raw.poses], np.int64)
    position, rotation = align_poses(
        stamps,
        pose_stamps,
        np.stack([p.position for p in raw.poses]),
        np.stack([p.rotation for p in raw.poses]),
        f"{bag}: {GRIPPER_POSE}",
    )
    count = position.shape[1]
    sizes = {len(c) for c in raw.closed}
    if sizes != {count}:
        raise BagError(f"{bag}: {GRIPPER_CLOSED} has {sorted(sizes)} flags a message", allowed=f"{count}, one a pose")
    flag_stamps = flag_times(np.array(raw.closed_log, np.int64), np.array(raw.pose_log, np.int64), pose_stamps)
    order = np.argsort(flag_stamps, kind="stable")
    closed = align_flags(stamps, flag_stamps[order], np.stack(raw.closed)[order], f"{bag}: {GRIPPER_CLOSED}")
    return Grip(
        torch.as_tensor(position, dtype=torch.float32),
        torch.as_tensor(rotation, dtype=torch.float32),
        torch.as_tensor(closed),
    )


def _held(tracks: Tracks, grips: Grip, held: Mapping[int, int] | None, bag: str) -> NDArray[np.int32]:
    count = grips.position.shape[1]
    result = np.full(len(tracks.id), -1, np.int32)
    if held is not None:
        for particle, gripper in held.items():
            column = np.flatnonzero(tracks.id == particle)
            if not len(column) or not 0 <= gripper < count:
                raise BagError(
                    f"{bag}: held says particle {particle} is in gripper {gripper}",
                    got=f"{len(tracks.id)} particles with ids {tracks.id[0]} to {tracks.id[-1]} and {count} grippers",
                )
            result[column] = gripper
        return result
    distance = np.linalg.norm(tracks.position[0][:, None] - grips.position[0].double().numpy()[None], axis=-1)
    distance[:, ~grips.closed[0].numpy()] = np.inf
    distance[~np.isfinite(distance)] = np.inf
    if distance.size:
        nearest = distance.argmin(axis=1)
        close = distance.min(axis=1) <= GRASP_RADIUS
        result[close] = nearest[close]
    return result



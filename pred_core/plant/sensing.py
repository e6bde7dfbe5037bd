"""What a tracker makes of the true material points: noise, occlusions, lost frames, uneven stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.plant.drive import poses
from pred_core.plant.hidden.effect import HiddenEffect
from pred_core.plant.session import EpisodePlan
from pred_core.plant.world import Record
from pred_core.types import Episode, Grip, ObjectInfo, Tracks

Array = NDArray[np.float64]
FIRST_STAMP = 1_000_000_000  # [ns] beginning of the session; 0 means "no time" in ROS
WHOLE = 3  # the first frames are complete, so that an episode can begin at them


@dataclass(frozen=True)
class SensorConfig:
    """The tracker and its faults."""

    rate: float = setting(30.0, unit="Hz", low=1.0, high=150.0, doc="of the tracks")
    noise: float = setting(7e-4, unit="m", low=0.0, high=0.05, doc="standard deviation of a coordinate, white")
    wander: float = setting(3e-4, unit="m", low=0.0, high=0.05, doc="standard deviation of a slow error")
    wander_time: float = setting(0.5, unit="s", low=0.01, doc="over which the slow error changes")
    jitter: float = setting(1.2e-3, unit="s", low=0.0, high=0.005, doc="standard deviation of capture times")
    lost: float = setting(0.004, low=0.0, high=0.2, doc="share of frames that are lost, one by one")
    dropout: float = setting(0.004, low=0.0, high=0.5, doc="share of single particles not seen")
    occlusions: float = setting(0.2, unit="1/s", low=0.0, high=10.0, doc="rate of hidden stretches of the object")


@dataclass(frozen=True)
class Seen:
    """Everything the tracker draws for an episode, before it sees anything: the same for every hidden effect."""

    time: Array  # (T,) [s] capture times
    error: Array  # (T, P, 3) [m]
    visible: NDArray[np.bool_]  # (T, P)


def draw_seen(sensor: SensorConfig, generator: np.random.Generator, seconds: float, particles: int) -> Seen:
    """Capture times, errors and occlusions of an episode of `seconds` [s]."""
    frames = int(round(seconds * sensor.rate))
    period = 1.0 / sensor.rate
    shift = np.clip(generator.normal(0.0, sensor.jitter, frames), -3 * sensor.jitter, 3 * sensor.jitter)
    time = np.clip(np.arange(frames) * period + shift, 0.0, None)
    error = generator.normal(0.0, sensor.noise, (frames, particles, 3))
    keep = np.exp(-period / sensor.wander_time)
    slow = generator.normal(0.0, sensor.wander, (frames, particles, 3))
    for t in range(1, frames):
        slow[t] = keep * slow[t - 1] + np.sqrt(1.0 - keep * keep) * slow[t]
    visible = generator.random((frames, particles)) >= sensor.dropout
    for _ in range(generator.poisson(sensor.occlusions * seconds)):
        begin, first = int(generator.integers(0, frames)), int(generator.integers(0, particles))
        length, width = round(generator.uniform(0.1, 0.4) * sensor.rate), int(generator.integers(2, 7))
        visible[begin : begin + length, first : first + width] = False
    visible[:WHOLE] = True
    lost = generator.random(frames) < sensor.lost
    lost[:WHOLE] = lost[-1] = False
    for t in np.flatnonzero(lost).tolist():  # never two in a row: the gripper's pose is lost with the frame
        lost[t] = not lost[t - 1]
    return Seen(time[~lost], (error + slow)[~lost], visible[~lost])


def observe(
    plan: EpisodePlan, record: Record, seen: Seen, effects: Sequence[HiddenEffect], object: ObjectInfo
) -> Episode:
    """The episode as it goes into the bag. Measurement effects act here, on the tracks only."""
    time, error, visible = seen.time, seen.error, seen.visible
    position = record.position_at(time - sum(e.delay for e in effects))
    for effect in effects:
        position = effect.observe(position)
    position = np.where(visible[..., None], position + error, np.nan)
    stamps = FIRST_STAMP + np.round((plan.start + time) * 1e9).astype(np.int64)
    place, rotation = poses(record.gripper_at(time))
    frames, count = visible.shape
    held = np.full(count, -1, np.int32)
    for particle, gripper in plan.held(count).items():
        held[particle] = gripper
    return Episode(
        name=plan.name,
        object=object,
        stamps=stamps,
        tracks=Tracks(stamps, position, np.arange(count, dtype=np.uint32), visible, visible.astype(np.float32)),
        grips=Grip(
            torch.as_tensor(place[:, None], dtype=torch.float32),
            torch.as_tensor(rotation[:, None], dtype=torch.float32),
            torch.ones(frames, 1, dtype=torch.bool),
        ),
        held=held,
        split=plan.split,
        recording=plan.recording,
    )

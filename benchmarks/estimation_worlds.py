"""Exact truth of a rope (MuJoCo) and what a tracker with faults makes of it, for `benchmarks/estimation.py`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.estimate.measurement import Measurement
from pred_core.plant.drive import poses
from pred_core.plant.rope_case import simulate_rope
from pred_core.plant.session import SessionConfig, plan_session
from pred_core.plant.world import Record
from pred_core.types import Array, Grip

PARTICLES = 30  # as the twin plant_rope
RATE = 15.0  # [Hz] of the tracks
NOISE, WANDER, WANDER_TIME = 0.002, 0.001, 0.5  # [m] white, [m] slow, [s]
FAULT = (2.0, 3.3)  # [s]
DEAD_BIAS = 0.004  # [m] of what is left when a camera dies


@dataclass(frozen=True)
class World:
    """One episode, with the truth."""

    name: str
    seconds: float
    record: Record

    def truth(self, time: float) -> Array:
        """(N, 3) [m]."""
        return self.record.position_at(np.array([time]))[0]

    def grip(self, time: float) -> Grip:
        """The gripper (1,), always closed."""
        place, turn = poses(self.record.gripper_at(np.array([time])))
        return Grip(
            torch.as_tensor(place, dtype=torch.float32),
            torch.as_tensor(turn, dtype=torch.float32),
            torch.ones(1, dtype=torch.bool),
        )


@dataclass(frozen=True)
class Fault:
    """What goes wrong with the tracks, beside noise."""

    name: str
    said: str
    hidden: bool = False  # the free half, during FAULT
    dropout: float = 0.0  # share of single tracks
    dead_camera: bool = False  # from FAULT[0] on: noise doubled, a bias, six neighbours lost
    wrong: float = 0.0  # share of tracks that are 5 to 20 cm off
    swapped: bool = False  # ten neighbours in reverse order for 0.5 s from FAULT[0] on
    delay: float = 0.0  # [s] from capture to arrival

    @property
    def span(self) -> tuple[float, float]:
        """[s] over which errors count: the fault's own time, or the episode after its first second."""
        if self.hidden:
            return FAULT
        if self.swapped:
            return FAULT[0], FAULT[0] + 0.5
        return (FAULT[0], np.inf) if self.dead_camera else (1.0, np.inf)


FAULTS = (
    Fault("none", "noise alone"),
    Fault("hidden", "half the rope hidden for 1.3 s", hidden=True),
    Fault("dropout", "30 % of the tracks missing", dropout=0.3),
    Fault("camera", "a camera dies: noise doubled, 4 mm bias, 6 particles lost", dead_camera=True),
    Fault("wrong", "5 % of the tracks 5 to 20 cm off", wrong=0.05),
    Fault("swapped", "10 neighbours swapped for 0.5 s", swapped=True),
    Fault("delay", "100 ms from capture to arrival", delay=0.1),
    Fault("all", "hidden half, 30 % missing, 5 % wrong, 100 ms", hidden=True, dropout=0.3, wrong=0.05, delay=0.1),
)


def make_worlds(episodes: int, seconds: float, seed: int) -> Iterator[World]:
    """Rope in the air and on the table, in turn."""
    for plan in plan_session(SessionConfig(train=0, test=episodes, ood=0, seconds=seconds, particles=PARTICLES), seed):
        yield World(plan.name, seconds, simulate_rope(plan, (), seed, seconds, PARTICLES)[0])


def make_tracks(world: World, fault: Fault, generator: np.random.Generator) -> list[Measurement]:
    """The tracks of an episode in order of capture."""
    begin = generator.uniform(0.0, 1.0 / RATE)
    times = np.arange(begin, world.seconds, 1.0 / RATE)
    shape = (len(times), PARTICLES, 3)
    error = generator.normal(0.0, NOISE, shape)
    slow = generator.normal(0.0, WANDER, shape)
    keep = np.exp(-1.0 / RATE / WANDER_TIME)
    for t in range(1, len(times)):
        slow[t] = keep * slow[t - 1] + np.sqrt(1.0 - keep * keep) * slow[t]
    seen = generator.random(shape[:2]) >= fault.dropout
    position = world.record.position_at(times)
    in_fault = (times >= FAULT[0]) & (times < FAULT[1])
    if fault.swapped:
        swapped = (times >= FAULT[0]) & (times < FAULT[0] + 0.5)
        position[swapped, 10:20] = position[swapped, 10:20][:, ::-1]
    if fault.dead_camera:
        dead = times >= FAULT[0]
        error[dead] *= 2.0
        way = generator.normal(size=3)
        error[dead] += DEAD_BIAS * way / np.linalg.norm(way)
        first = int(generator.integers(2, PARTICLES - 6))
        seen[dead, first : first + 6] = False
    if fault.hidden:
        seen[in_fault, PARTICLES // 2 :] = False
    position = position + error + slow
    wrong = generator.random(shape[:2]) < fault.wrong
    way = generator.normal(size=shape)
    far = generator.uniform(0.05, 0.2, shape[:2])
    position[wrong] += (far[..., None] * way / np.linalg.norm(way, axis=-1, keepdims=True))[wrong]
    return [_measured(round(t * 1e9), p, s) for t, p, s in zip(times, position, seen, strict=True)]


def _measured(stamp: int, position: Array, seen: NDArray[np.bool_]) -> Measurement:
    """As a tracker writes it whose standard deviation is NOISE."""
    index = np.flatnonzero(seen)
    return Measurement(stamp, index, position[index], np.full(len(index), np.exp(-NOISE / 0.01)))

"""A state out of tracks alone: what was seen in the last moments, and the rest from the shape of the body."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.filter import ErrorFilter, Evidence
from pred_core.estimate.gate import agreeing
from pred_core.estimate.history import NS
from pred_core.estimate.lengths import Lengths
from pred_core.estimate.measurement import Measurement
from pred_core.estimate.modes import SMOOTHER, error_modes
from pred_core.types import Array, Body

SHAPE = 0.3  # [m] how far the body may be from its rest shape, moved as a whole
SPEED = 1.0  # [m/s]
FULL = 0.6  # share of the window that its tracks must span
SLOWEST = 0.02  # [s] between two looks at a particle that give it a velocity


@dataclass(frozen=True)
class Start:
    """A moving object at one instant."""

    stamp: int  # [ns] of the newest tracks in it
    position: Array  # (N, 3) [m] world
    velocity: Array  # (N, 3) [m/s]
    track: Array  # (N, 3) [m] where a particle was seen; NaN: it was placed by the shape of the body


class Starter:
    """Feed it tracks in order of time; `find` gives a start once enough of the body was seen."""

    def __init__(self, body: Body, config: EstimatorConfig):
        self._body, self._config = body, config
        self._seen: deque[Measurement] = deque()
        nobody = np.zeros(body.count, bool)
        self.modes = error_modes(body, nobody, SMOOTHER * config.correlation, config.modes)
        self._lengths = Lengths(body, np.ones(body.count))

    def add(self, seen: Measurement) -> None:
        """Tracks newer than those before. Raises: InputError as `Measurement.check` does; nothing is kept then."""
        seen.check(self._body.count)
        good = seen.confidence > self._config.least_confidence
        self._seen.append(Measurement(seen.stamp, seen.index[good], seen.position[good], seen.confidence[good]))
        while len(self._seen) > 2 and (seen.stamp - self._seen[0].stamp) / NS > self._config.start_window:
            self._seen.popleft()

    def clear(self) -> None:
        """Forget all."""
        self._seen.clear()

    def unseen(self) -> NDArray[np.int64]:
        """Particles nothing is known of."""
        seen = [m.index for m in self._seen]
        return np.setdiff1d(np.arange(self._body.count), np.concatenate(seen) if seen else [])

    def find(self) -> Start | None:
        """None until the window is full and enough particles were seen in it."""
        if len(self._seen) < 2 or len(self.unseen()) > (1.0 - self._config.least_seen) * self._body.count:
            return None
        stamp = self._seen[-1].stamp
        if (stamp - self._seen[0].stamp) / NS < FULL * self._config.start_window:
            return None
        index, place, speed, moving = self._newest(stamp)
        reference = _moved_onto(self._body.rest_position, index, place)
        noise = np.full(len(index), self._config.noise**2)
        evidence = Evidence(index, place - reference[index], noise)
        position, believed = self._spread(evidence, SHAPE)
        span = self._config.start_window if self._config.start_window else SLOWEST
        velocities = Evidence(index, speed, noise * 2.0 / span**2).only(moving & believed)
        velocity, _ = self._spread(velocities, SPEED)
        shaped = self._lengths.keep(self._body.rest_position, reference + position)
        track = np.full((self._body.count, 3), np.nan)
        track[index[believed]] = place[believed]
        return Start(stamp, shaped, velocity, track)

    def _newest(self, stamp: int) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.bool_]]:
        """Particles (O,), places (O, 3) at `stamp`, velocities (O, 3), and which of them (O,) have one."""
        first: dict[int, tuple[int, Array]] = {}
        last: dict[int, tuple[int, Array]] = {}
        for m in self._seen:
            for i, p in zip(m.index.tolist(), m.position, strict=True):
                first.setdefault(i, (m.stamp, p))
                last[i] = (m.stamp, p)
        index = np.array(sorted(last), np.int64)
        span = np.array([(last[i][0] - first[i][0]) / NS for i in index.tolist()])
        moving = span >= SLOWEST
        apart = np.stack([last[i][1] - first[i][1] for i in index.tolist()])
        velocity = np.where(moving[:, None], apart / np.maximum(span, SLOWEST)[:, None], 0.0)
        old = np.array([(stamp - last[i][0]) / NS for i in index.tolist()])
        place = np.stack([last[i][1] for i in index.tolist()]) + velocity * old[:, None]
        return index, place, velocity, moving

    def _spread(self, evidence: Evidence, size: float) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 3) smooth values of about `size` that agree with the evidence, and what (O,) of it was believed."""
        config = replace(self._config, start_position=size)
        errors = ErrorFilter(self.modes, config)
        among = np.ones(len(evidence.index), bool)
        if not among.any():
            return np.zeros((self._body.count, 3)), among
        believed = agreeing(errors, evidence, among, config.gate**2)
        return errors.update(evidence.only(believed)).position, believed


def _moved_onto(rest: Array, index: NDArray[np.int64], place: Array) -> Array:
    """(N, 3) `rest`, turned and shifted as a whole so that particles `index` lie nearest to `place` (Kabsch)."""
    middle, target = rest[index].mean(axis=0), place.mean(axis=0)
    u, _, v = np.linalg.svd((rest[index] - middle).T @ (place - target))
    mirror = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ v)))])
    return np.asarray((rest - middle) @ (u @ mirror @ v) + target)

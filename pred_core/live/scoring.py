"""Predictions against the tracks that arrive for the same instant: the evaluator's bookkeeping, without ROS."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.clouds import PointFrame
from pred_core.errors import InputError
from pred_core.live.laps import Laps, Time
from pred_core.live.marks import EpisodeMark
from pred_core.metrics.correspondence import coordinate_l1, mde
from pred_core.types import Array

LATE = 1.0  # [s] a jump back by more is a loop; by less, the message is late
MOST_FRAMES = 100_000  # measured frames kept; beyond it the oldest episode is released (a replay in a loop)
FIRST_PREDICTED = 2  # frames 0 and 1 are the start of every prediction
T = TypeVar("T")


@dataclass
class Series(Generic[T]):
    """Values in the order of their stamps, one topic. `laps` is shared by the topics that are compared."""

    topic: str
    laps: Laps[T]
    times: list[Time] = field(default_factory=list)
    values: list[T] = field(default_factory=list)
    total: int = 0  # values that came, also those forgotten since

    def append(self, stamp: int, value: T) -> list[tuple[Time, T]]:
        """Add a value, after the one it confirms if there is one; returns what was added.

        Raises: InputError for a stamp that is late or far ahead (laps.py).
        """
        added = self.laps.take(self.topic, stamp, value)
        for time, item in added:
            while self.times and self.times[-1] >= time:  # their stamps were out of line
                self.times.pop()
                self.values.pop()
            self.times.append(time)
            self.values.append(item)
        self.total += len(added)
        return added

    def forget(self, before: Time) -> None:
        """Drop the values before `before`."""
        count = bisect_left(self.times, before)
        del self.times[:count], self.values[:count]

    def at(self, time: Time, tolerance: int) -> T | None:
        """The value nearest to `time` within `tolerance` [ns], or None."""
        k = bisect_left(self.times, time)
        near = [i for i in (k - 1, k) if 0 <= i < len(self.times) and self.times[i][0] == time[0]]
        best = min(near, key=lambda i: abs(self.times[i][1] - time[1]), default=None)
        if best is None or abs(self.times[best][1] - time[1]) > tolerance:
            return None
        return self.values[best]


@dataclass(frozen=True)
class Scored:
    """One episode as it was seen live: T announced frames, P particles in the order of `id`."""

    name: str
    split: str
    recording: int
    stamps: NDArray[np.int64]  # (T,) [ns] as published
    id: NDArray[np.uint32]  # (P,)
    measured: Array  # (T, P, 3) [m] world; NaN where hidden
    predicted: Array  # (T, P, 3) [m] world; NaN where none came
    announced: int  # frames the player promised
    line: bool  # consecutive particles are neighbours

    @property
    def scorable(self) -> NDArray[np.bool_]:
        """(T,) frames that have a prediction."""
        return np.asarray(np.isfinite(self.predicted).all(axis=(1, 2))) & bool(len(self.id))

    @property
    def lost(self) -> int:
        """Announced frames that lack a measurement or, after the start, a prediction."""
        return self.announced - len(self.stamps) + int((~self.scorable[FIRST_PREDICTED:]).sum())


class Scorer:
    """Feed it marks, points and predictions in any order across topics; ask for running or final scores."""

    def __init__(self, tolerance: float, most_frames: int = MOST_FRAMES):
        """`tolerance` [s]: how far apart the stamps of a pair may be; `most_frames`: measured frames kept."""
        self._tolerance = round(tolerance * 1e9)
        self._most_frames = most_frames
        laps: Laps[Any] = Laps(LATE)
        self.points: Series[PointFrame] = Series("tracker/points", laps)
        self.predictions: Series[tuple[NDArray[np.uint32], Array]] = Series("prediction/points", laps)
        self.marks: list[EpisodeMark] = []
        self.announced = 0  # episodes
        self.released = 0  # episodes that the final score does not cover any more
        self._promised = self._to_predict = 0  # frames
        self.pairs = 0
        self._sum_mde = self._sum_l1 = 0.0

    def add_mark(self, mark: EpisodeMark) -> None:
        """An episode begins."""
        self.marks.append(mark)
        self.announced += 1
        self._promised += mark.frames
        self._to_predict += max(0, mark.frames - FIRST_PREDICTED)

    def add_points(self, frame: PointFrame) -> None:
        """A measured frame. Raises: InputError for its stamp (laps.py)."""
        for time, measured in self.points.append(frame.stamp, frame):
            found = self.predictions.at(time, self._tolerance)
            if found is not None:
                self._pair(found, measured)
        if len(self.points.times) > self._most_frames:
            self._release()

    def add_prediction(self, stamp: int, ids: NDArray[np.uint32], position: Array) -> None:
        """A predicted frame, position (N, 3) [m]. Raises: InputError for its stamp (laps.py)."""
        for time, prediction in self.predictions.append(stamp, (ids, position)):
            frame = self.points.at(time, self._tolerance)
            if frame is not None:
                self._pair(prediction, frame)

    @property
    def running(self) -> tuple[float, float]:
        """Mean `mde` and `coordinate_l1` [m] over all pairs so far; NaN before the first."""
        return (self._sum_mde / self.pairs, self._sum_l1 / self.pairs) if self.pairs else (np.nan, np.nan)

    def complete(self) -> bool:
        """True when every announced frame, and its prediction, has arrived."""
        arrived = self.points.total >= self._promised and self.predictions.total >= self._to_predict
        return self.announced > 0 and arrived

    def episodes(self) -> list[Scored]:
        """What was seen, cut at the marks; without marks, one episode of everything.

        Raises: InputError if nothing was measured.
        """
        if not self.points.times:
            raise InputError("nothing to score: no tracker/points came", next_step="Start the player")
        marks = sorted(self.marks, key=lambda m: m.begin)
        if not marks:
            marks = [EpisodeMark("live", 0, 1, self.points.times[0][1], len(self.points.times))]
        ends = [m.begin for m in marks[1:]] + [2**62]
        return [self._cut(mark, end) for mark, end in zip(marks, ends, strict=True)]

    def _release(self) -> None:
        """Forget the oldest episode; without a later mark, the oldest tenth of the frames."""
        self.marks.sort(key=lambda m: m.begin)
        until = self.points.times[max(1, len(self.points.times) // 10)]
        if len(self.marks) > 1:
            begin = self.marks[1].begin
            until = next((t for t in self.points.times if t[1] >= begin), until)
            self.marks.pop(0)
            self.released += 1
        slack = (until[0], until[1] - self._tolerance)
        self.points.forget(until)
        self.predictions.forget(slack)

    def _cut(self, mark: EpisodeMark, end: int) -> Scored:
        inside = [k for k, (_, stamp) in enumerate(self.points.times) if mark.begin <= stamp < end]
        frames = [self.points.values[k] for k in inside]
        ids = np.unique(np.concatenate([f.id for f in frames])) if frames else np.zeros(0, np.uint32)
        shape = (len(frames), len(ids), 3)
        measured, predicted = np.full(shape, np.nan), np.full(shape, np.nan)
        for t, (k, frame) in enumerate(zip(inside, frames, strict=True)):
            measured[t, np.searchsorted(ids, frame.id)] = frame.position
            found = self.predictions.at(self.points.times[k], self._tolerance)
            if found is not None:
                predicted[t] = _in_order(found, ids)
        stamps = np.array([f.stamp for f in frames], np.int64)
        return Scored(
            mark.name, mark.split, mark.recording, stamps, ids, measured, predicted, mark.frames, mark.kind == "line"
        )

    def _pair(self, prediction: tuple[NDArray[np.uint32], Array], frame: PointFrame) -> None:
        predicted = _in_order(prediction, frame.id)[None]
        measured, visible = frame.position[None], frame.visible[None]
        if visible.any():
            self.pairs += 1
            self._sum_mde += float(mde(predicted, measured, visible)[0])
            self._sum_l1 += float(coordinate_l1(predicted, measured, visible)[0])


def _in_order(prediction: tuple[NDArray[np.uint32], Array], ids: NDArray[np.uint32]) -> Array:
    """The predicted positions (P, 3) of `ids`. Raises: InputError if one is not predicted."""
    own, position = prediction
    order = np.argsort(own)
    columns = np.minimum(np.searchsorted(own, ids, sorter=order), len(own) - 1)
    chosen = order[columns]
    if not np.array_equal(own[chosen], ids):
        missing = np.setdiff1d(ids, own)
        raise InputError("prediction/points lacks measured particles", got=f"no ids {missing[:5].tolist()}")
    return np.asarray(position, np.float64)[chosen]

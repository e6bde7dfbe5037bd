"""The data gate: what looks wrong in an episode, marker by marker. It reports; it never drops or repairs.

Pairs of neighbouring particles stand in for the object's edges: consecutive ids along a line, otherwise
the nearest few. A tracked material point keeps its distance to its neighbours, moves smoothly, and does not
change places with them; what breaks this is a fault of the measurement, not a motion of the object.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.types import Episode

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GateLimits:
    """From where on something is flagged."""

    spike: float = setting(0.01, unit="m", low=0.0, doc="a marker off the line between its frames before and after")
    stretch: float = setting(0.2, unit="", low=0.0, doc="change of a neighbour distance against the data set's median")
    slip: float = setting(0.08, unit="", low=0.0, doc="the same, of the episode's median: a marker that has moved")
    speed: float = setting(8.0, unit="m/s", low=0.0, doc="of a particle")
    hidden: float = setting(0.02, unit="", low=0.0, doc="share of particles times frames not measured")
    jitter: float = setting(0.2, unit="", low=0.0, doc="largest deviation of a frame from its period, in periods")


@dataclass(frozen=True)
class EpisodeQuality:
    """The gate's findings on one episode."""

    name: str
    split: str
    recording: int
    frames: int
    particles: int
    seconds: float  # [s]
    hidden: float  # share of particles x frames not measured
    lost_frames: int  # frames in which nothing was measured
    glitch_marker_frames: int  # markers x frames off the line between the frames before and after
    swapped_frames: int  # frames at which two neighbours change places
    stretch_max: float  # largest |distance / data set median - 1| of neighbours that are not both held
    stretch_frames: int  # frames in which a neighbour distance exceeds the limit
    slip_max: float  # largest |episode median / data set median - 1| of a neighbour distance
    speed_max: float  # [m/s]
    jitter_max: float  # [periods]
    flags: tuple[str, ...]  # one line each; empty: nothing looks wrong


def neighbour_pairs(episode: Episode, count: int = 4) -> NDArray[np.int64]:
    """Pairs (E, 2) of particle indices: consecutive on a line, else the `count` nearest by median position."""
    particles = len(episode.tracks.id)
    if episode.object.kind == "line":
        return np.stack([np.arange(particles - 1), np.arange(1, particles)], axis=-1)
    # The frame that shows most particles; those hidden in it pair with nobody.
    frame = int(episode.tracks.visible.sum(axis=1).argmax())
    place = episode.position[frame]
    pairs = set()
    for i in np.flatnonzero(np.isfinite(place).all(-1)):
        distance = np.linalg.norm(place - place[i], axis=-1)
        distance[i] = np.inf
        for j in np.argsort(distance)[:count]:
            if np.isfinite(distance[j]):
                pairs.add((min(i, j), max(i, j)))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def pair_lengths(episode: Episode, pairs: NDArray[np.int64]) -> Array:
    """Distances (T, E) [m] of the pairs; NaN where one is hidden."""
    return np.linalg.norm(episode.position[:, pairs[:, 1]] - episode.position[:, pairs[:, 0]], axis=-1)


def examine(
    episode: Episode, pairs: NDArray[np.int64], reference: Array, limits: GateLimits | None = None
) -> EpisodeQuality:
    """The findings on one episode. reference (E,) [m]: usual distances of `pairs`, e.g. the data set's medians."""
    limits = limits or GateLimits()
    position, visible = episode.position, episode.tracks.visible
    period = episode.period
    # Pairs of clamped particles measure the gripper, not the object.
    free = ~((episode.held[pairs] >= 0).all(axis=1))
    change = np.abs(pair_lengths(episode, pairs) / reference - 1.0)[:, free]
    middle = np.abs(_median(pair_lengths(episode, pairs)) / reference - 1.0)[free]
    off_line = np.linalg.norm(position[1:-1] - 0.5 * (position[2:] + position[:-2]), axis=-1)
    steps = np.linalg.norm(np.diff(position, axis=0), axis=-1)
    seconds = np.diff(episode.stamps) * 1e-9
    speed = steps / seconds[:, None]
    quality = EpisodeQuality(
        name=episode.name,
        split=episode.split,
        recording=episode.recording,
        frames=len(episode.stamps),
        particles=position.shape[1],
        seconds=float(seconds.sum()),
        hidden=float(1.0 - visible.mean()),
        lost_frames=int((~visible.any(axis=1)).sum()),
        glitch_marker_frames=int((off_line > limits.spike).sum()),
        swapped_frames=_swaps(position, pairs, steps),
        stretch_max=_largest(change),
        stretch_frames=int((change > limits.stretch).any(axis=1).sum()) if change.size else 0,
        slip_max=_largest(middle),
        speed_max=_largest(speed),
        jitter_max=float(np.abs(seconds / period - 1.0).max()),
        flags=(),
    )
    return dataclasses.replace(quality, flags=_flags(quality, limits))


def examine_all(
    read: Callable[[], Iterable[Episode]], limits: GateLimits | None = None
) -> list[EpisodeQuality]:
    """The findings on every episode of a data set. `read` is called twice: first for the usual distances."""
    pairs: NDArray[np.int64] | None = None
    medians: list[Array] = []
    ids: NDArray[np.uint32] | None = None
    for episode in read():
        if pairs is None:
            pairs, ids = neighbour_pairs(episode), episode.tracks.id
        if ids is not None and np.array_equal(ids, episode.tracks.id):
            medians.append(_median(pair_lengths(episode, pairs)))
    reference = _median(np.stack(medians)) if medians else np.zeros(0)
    found = []
    for episode in read():
        if pairs is not None and ids is not None and np.array_equal(ids, episode.tracks.id):
            found.append(examine(episode, pairs, reference, limits))
        else:  # other particles than the first episode: its own distances are the only measure
            own = neighbour_pairs(episode)
            quality = examine(episode, own, _median(pair_lengths(episode, own)), limits)
            line = "its particle ids differ from those of the first episode"
            found.append(dataclasses.replace(quality, flags=(line, *quality.flags)))
    return found


def _swaps(position: Array, pairs: NDArray[np.int64], steps: Array) -> int:
    """Frames at which exchanging two neighbours would make the motion at least three times shorter."""
    a, b = pairs[:, 0], pairs[:, 1]
    straight = steps[:, a] + steps[:, b]
    crossed = np.linalg.norm(position[1:, a] - position[:-1, b], axis=-1)
    crossed += np.linalg.norm(position[1:, b] - position[:-1, a], axis=-1)
    return int((3.0 * crossed < straight).any(axis=1).sum())


def _flags(q: EpisodeQuality, limits: GateLimits) -> tuple[str, ...]:
    lines = []
    if q.swapped_frames:
        lines.append(f"neighbouring markers change places at {q.swapped_frames} frames")
    if q.glitch_marker_frames:
        lines.append(f"{q.glitch_marker_frames} marker frames jump by more than {limits.spike * 1e3:g} mm and back")
    if q.stretch_max > limits.stretch:
        lines.append(f"neighbour distance changes by up to {q.stretch_max:.0%} in {q.stretch_frames} frames")
    if q.slip_max > limits.slip:
        lines.append(f"a marker has slipped or moved: usual distance differs by {q.slip_max:.1%}")
    if q.speed_max > limits.speed:
        lines.append(f"implausible speed {q.speed_max:.1f} m/s")
    if q.hidden > limits.hidden:
        lines.append(f"{q.hidden:.1%} not measured")
    if q.lost_frames:
        lines.append(f"{q.lost_frames} frames lost")
    if q.jitter_max > limits.jitter:
        lines.append(f"frames up to {q.jitter_max:.2f} periods late or early")
    return tuple(lines)


def _median(values: Array) -> Array:
    """Median over the first axis that ignores hidden entries; NaN where all are hidden."""
    result = np.full(values.shape[1:], np.nan)
    seen = np.isfinite(values).any(axis=0)
    result[seen] = np.nanmedian(values[:, seen], axis=0)
    return result


def _largest(values: Array) -> float:
    """Largest finite entry, 0 if there is none."""
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else 0.0

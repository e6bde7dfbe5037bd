"""Held particles and the poses of what holds them: all that the model-free gate reads of an episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.types import Array, Episode

FRAMES = 150  # compared in an episode; errors of neighbouring frames are alike, more would add little


@dataclass(frozen=True)
class HeldTrack:
    """One held particle of one episode, as long as its gripper stays closed."""

    id: int
    time: Array  # (T,) [s] from the episode's first stamp
    measured: Array  # (T, 3) [m] world, NaN where not seen
    place: Array  # (T, 3) [m] world, the gripper's reported origin
    axes: Array  # (T, 3, 3) world_from_gripper
    place_rate: Array  # (T, 3) [m/s]
    axes_rate: Array  # (T, 3, 3) [1/s]
    used: NDArray[np.int64]  # (F,) the frames that are compared: seen, and no more than FRAMES of them

    def pose_before(
        self, delay: float, frames: NDArray[np.int64]
    ) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
        """Place, axes, their rates, and where they are known (F,), `delay` [s] before `frames` (F,).

        Cubic Hermite interpolation; axes stay orthonormal to within the square of the turn between frames.
        """
        at = self.time[frames] - delay
        known = (at >= self.time[0]) & (at <= self.time[-1])
        k = np.clip(np.searchsorted(self.time, at, side="right"), 1, len(self.time) - 1)
        step = self.time[k] - self.time[k - 1]
        u = np.clip((at - self.time[k - 1]) / step, 0.0, 1.0)
        place, place_rate = _hermite(self.place, self.place_rate, k, u, step)
        axes, axes_rate = _hermite(self.axes, self.axes_rate, k, u, step)
        return place, axes, place_rate, axes_rate, known


def held_tracks(episode: Episode) -> list[HeldTrack]:
    """The episode's held particles, those that are seen at least twice while they are held."""
    time = (episode.stamps - episode.stamps[0]) * 1e-9
    tracks = []
    for column in np.flatnonzero(episode.held >= 0).tolist():
        gripper = int(episode.held[column])
        closed = episode.grips.closed[:, gripper].numpy().astype(bool)
        length = len(closed) if closed.all() else int(closed.argmin())
        if length < 3:
            continue
        seen = episode.tracks.visible[:length, column]
        measured = np.where(seen[:, None], episode.position[:length, column], np.nan)
        used = np.flatnonzero(np.isfinite(measured).all(axis=1))
        if len(used) < 2:
            continue
        place = episode.grips.position[:length, gripper].double().numpy()
        axes = rotation_matrices(episode.grips.rotation[:length, gripper].double().numpy())
        t = time[:length]
        tracks.append(
            HeldTrack(
                id=int(episode.tracks.id[column]),
                time=t,
                measured=measured,
                place=place,
                axes=axes,
                place_rate=np.gradient(place, t, axis=0),
                axes_rate=np.gradient(axes, t, axis=0),
                used=used[:: max(1, len(used) // FRAMES)],
            )
        )
    return tracks


def rotation_matrices(q: Array) -> Array:
    """(T, 3, 3) of unit quaternions (T, 4) wxyz."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _hermite(values: Array, rates: Array, k: np.ndarray, u: Array, step: Array) -> tuple[Array, Array]:
    """Values and rates at the fraction `u` of the interval that ends at frame `k`."""
    shape = (-1,) + (1,) * (values.ndim - 1)
    u, step = u.reshape(shape), step.reshape(shape)
    a, b, da, db = values[k - 1], values[k], rates[k - 1] * step, rates[k] * step
    value = a + u * (da + u * (3 * (b - a) - 2 * da - db + u * (2 * (a - b) + da + db)))
    slope = da + u * (2 * (3 * (b - a) - 2 * da - db) + 3 * u * (2 * (a - b) + da + db))
    return value, slope / step

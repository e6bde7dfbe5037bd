"""Where the error sits: per particle and direction, at which frequencies, at which speed of the grippers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.evaluate.protocol import FIRST_PREDICTED
from pred_core.metrics import coordinate_l1, scored
from pred_core.types import Array, Episode

DIRECTIONS = ("along", "vertical", "out of plane")
WORLD_AXES = ("x", "y", "z")
_PARALLEL = 0.02  # [m] horizontal distance of the ends below which "along" has no direction


@dataclass(frozen=True)
class ErrorMap:
    """Mean over episodes and steps. `directions` names the columns."""

    directions: tuple[str, ...]
    absolute: Array  # (P, 3) [m] mean absolute error
    bias: Array  # (P, 3) [m] mean signed error, predicted minus measured


def error_map(predictions: Sequence[Array], episodes: Sequence[Episode]) -> ErrorMap:
    """Error of every particle along the line between the two outermost held particles (horizontal part),
    vertically (against gravity) and out of that plane; in world axes when fewer than two are held.

    Diverged episodes must be left out by the caller. Frames in which the ends hang one above the other, where
    the plane has no direction, and hidden particles are left out.
    """
    framed = all((e.held >= 0).sum() >= 2 for e in episodes)
    total = np.zeros((episodes[0].position.shape[1], 3))
    signed, count = np.zeros_like(total), np.zeros((len(total), 1))
    for prediction, episode in zip(predictions, episodes, strict=True):
        measured = episode.position[FIRST_PREDICTED:]
        seen = scored(measured, episode.tracks.visible[FIRST_PREDICTED:])
        error = np.where(seen[..., None], prediction - np.where(seen[..., None], measured, 0.0), 0.0)
        if framed:
            axes, defined = _plane(measured, episode)
            error = np.einsum("tpi,tji->tpj", error, axes)
            seen = seen & defined[:, None]
        error = np.where(seen[..., None], error, 0.0)
        total += np.abs(error).sum(axis=0)
        signed += error.sum(axis=0)
        count += seen.sum(axis=0)[:, None]
    with np.errstate(invalid="ignore"):  # a particle that is never seen has no error: NaN
        return ErrorMap(DIRECTIONS if framed else WORLD_AXES, total / count, signed / count)


def error_spectrum(predictions: Sequence[Array], episodes: Sequence[Episode]) -> tuple[Array, Array]:
    """Share of the squared error of free particles below each frequency: (F,) [Hz], (F,) 0 to 1.

    Over episodes of the commonest length in which no particle is hidden; bias counts as 0 Hz.
    """
    lengths = [len(p) for p in predictions]
    common = max(set(lengths), key=lengths.count)
    power, period = np.zeros(common // 2 + 1), episodes[0].period
    for prediction, episode in zip(predictions, episodes, strict=True):
        measured = episode.position[FIRST_PREDICTED:]
        if len(prediction) != common or not scored(measured, episode.tracks.visible[FIRST_PREDICTED:]).all():
            continue
        error = (prediction - measured)[:, episode.held < 0]
        spectrum = np.abs(np.fft.rfft(error, axis=0)) ** 2
        spectrum[1 : (common + 1) // 2] *= 2.0  # the negative frequencies
        power += spectrum.sum(axis=(1, 2))
    total = power.sum()
    share = np.cumsum(power) / total if total > 0 else np.ones_like(power)
    return np.asarray(np.fft.rfftfreq(common, period), dtype=np.float64), np.asarray(share)


def error_by_speed(predictions: Sequence[Array], episodes: Sequence[Episode], bins: int = 8) -> tuple[Array, Array]:
    """Mean error per coordinate against the mean speed of the held particles: (B,) [m/s], (B,) [m].

    Bins hold equally many frames. Without held particles, the speed of the object's mean position.
    """
    speeds, errors = [], []
    for prediction, episode in zip(predictions, episodes, strict=True):
        measured = episode.position[FIRST_PREDICTED:]
        errors.append(coordinate_l1(prediction, measured, episode.tracks.visible[FIRST_PREDICTED:]))
        held = episode.held >= 0
        followed = episode.position[:, held if held.any() else slice(None)]
        moved = np.diff(followed, axis=0)[FIRST_PREDICTED - 1 :]
        moved = moved if held.any() else moved.mean(axis=1, keepdims=True)
        speeds.append(np.linalg.norm(moved, axis=-1).mean(axis=1) / episode.period)
    speed, error = np.concatenate(speeds), np.concatenate(errors)
    usable = np.isfinite(speed) & np.isfinite(error)
    order = np.argsort(speed[usable], kind="stable")
    parts = [p for p in np.array_split(order, bins) if len(p)]
    return np.array([speed[usable][p].mean() for p in parts]), np.array([error[usable][p].mean() for p in parts])


def _plane(measured: Array, episode: Episode) -> tuple[Array, NDArray[np.bool_]]:
    """Unit vectors along, vertical, out of plane as rows, (T, 3, 3), and where they are defined, (T,)."""
    up = -np.asarray(episode.gravity) / np.linalg.norm(episode.gravity)
    held = np.flatnonzero(episode.held >= 0)
    chord = measured[:, held[-1]] - measured[:, held[0]]
    chord = chord - (chord @ up)[:, None] * up
    length = np.linalg.norm(chord, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = chord / length[:, None]
    defined = np.isfinite(along).all(axis=1) & (length > _PARALLEL)
    along = np.where(defined[:, None], along, 0.0)
    vertical = np.broadcast_to(up, along.shape)
    return np.stack((along, vertical, np.cross(along, vertical)), axis=1), defined

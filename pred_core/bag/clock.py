"""Frames moved onto an even clock: a simulator steps by one period, cameras do not keep it exactly."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.align import align_poses
from pred_core.types import Array, Episode, Grip

EVEN = 2e-5  # [s] of deviation that is left alone: a millimetre at 50 m/s


def even_stamps(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """(T,) [ns] the straight line through `stamps` (T,), by least squares."""
    frame = np.arange(len(stamps), dtype=np.float64)
    since = (stamps - stamps[0]).astype(np.float64)
    slope, first = np.polyfit(frame, since, 1)
    return np.asarray(stamps[0] + np.rint(first + slope * frame), dtype=np.int64)


def on_even_clock(episode: Episode) -> Episode:
    """The episode with tracks and grips at even stamps; as it is if its stamps are even already.

    A particle moves from its own frame to the even stamp with the slope of the parabola through the frames before,
    at and after (a camera that is 1 ms late sees a point at 2 m/s 2 mm further on); next to a frame in which it was
    not measured, with the straight line to the other neighbour; alone, it stays where it is. What was not measured
    stays so. Grips are interpolated between their neighbours in time.
    """
    even = even_stamps(episode.stamps)
    shift = (even - episode.stamps).astype(np.float64) * 1e-9
    if len(even) < 3 or float(np.abs(shift).max()) < EVEN:
        return episode
    position = episode.position + _velocity(episode.position, episode.stamps) * shift[:, None, None]
    tracks = dataclasses.replace(episode.tracks, position=position, stamp=even)
    return dataclasses.replace(episode, stamps=even, tracks=tracks, grips=_grips_at(episode, even))


def _velocity(position: Array, stamps: NDArray[np.int64]) -> Array:
    """(T, P, 3) [m/s] slope at every frame; 0 where no neighbour was measured."""
    step = np.diff(stamps).astype(np.float64)[:, None, None] * 1e-9
    slope = np.diff(position, axis=0) / step  # (T-1, P, 3)
    nothing = np.full_like(position[:1], np.nan)
    before, after = np.concatenate((nothing, slope)), np.concatenate((slope, nothing))
    ahead = np.concatenate((step, step[-1:])) / (np.concatenate((step[:1], step)) + np.concatenate((step, step[-1:])))
    both = before * ahead + after * (1.0 - ahead)
    one = np.where(np.isfinite(before), before, np.where(np.isfinite(after), after, 0.0))
    return np.asarray(np.where(np.isfinite(both), both, one))


def _grips_at(episode: Episode, stamps: NDArray[np.int64]) -> Grip:
    """Poses between the frames' own, linear and slerp; beyond the first and last frame, theirs."""
    inside = np.clip(stamps, episode.stamps[0], episode.stamps[-1])
    g = episode.grips
    position, rotation = align_poses(
        inside, episode.stamps, g.position.double().numpy(), g.rotation.double().numpy(), episode.name
    )
    return Grip(torch.as_tensor(position).to(g.position), torch.as_tensor(rotation).to(g.rotation), g.closed)


"""Puts gripper poses and closed flags on the stamps of the tracker."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import BagError

LONGEST_HOLE = 2.5  # sampling periods between two poses that are still interpolated: one lost message


def median_period(stamps: NDArray[np.int64]) -> float:
    """Median time between stamps [ns]; 0 for a single one."""
    return float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0


def align_poses(
    at: NDArray[np.int64],
    stamps: NDArray[np.int64],
    position: NDArray[np.float64],
    rotation: NDArray[np.float64],
    where: str,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses at the stamps `at` (T,) [ns]: linear in position, slerp in rotation; equal stamps copy exactly.

    position (M, G, 3) [m], rotation (M, G, 4) wxyz at `stamps` (M,). Before the first and after the last
    pose the nearest one counts within half a period. Raises: BagError if a frame lies further away, or in
    a hole of more than LONGEST_HOLE periods.
    """
    period = max(median_period(at), median_period(stamps))
    after = np.clip(np.searchsorted(stamps, at, side="left"), 0, len(stamps) - 1)
    before = np.where((stamps[after] > at) & (after > 0), after - 1, after)
    hole = (stamps[after] - stamps[before]) > LONGEST_HOLE * period
    outside = (after == before) & (np.abs(stamps[after] - at) > 0.5 * period)
    if (hole | outside).any():
        missing = np.flatnonzero(hole | outside)
        first = int(missing[0])
        nearest = int(np.abs(stamps[[before[first], after[first]]] - at[first]).min())
        raise BagError(
            f"{where}: no pose for {len(missing)} of {len(at)} frames, first at {at[first] * 1e-9:.3f} s",
            got=f"the nearest one {nearest * 1e-6:.1f} ms away",
            allowed=f"half a period, {0.5e-6 * period:.1f} ms, or one lost message",
            next_step="Record tracker and gripper on one clock for the whole episode",
        )
    span = np.maximum(stamps[after] - stamps[before], 1)
    weight = np.where(after == before, 0.0, (at - stamps[before]) / span)
    a, b = position[before], position[after]
    w = weight[:, None, None]
    return np.where(w == 0.0, a, a + w * (b - a)), slerp(rotation[before], rotation[after], weight[:, None])


def align_flags(
    at: NDArray[np.int64], stamps: NDArray[np.int64], flags: NDArray[np.bool_], where: str
) -> NDArray[np.bool_]:
    """Closed flags (T, G) at the stamps `at` (T,) [ns]: the nearest message.

    A single message counts for the whole episode. Raises: BagError if the flags begin after the first
    frame or stop, by more than half a period of the slower topic.
    """
    period = max(median_period(at), median_period(stamps))
    after = np.clip(np.searchsorted(stamps, at, side="left"), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(stamps[after] - at) < np.abs(stamps[before] - at), after, before)
    gap = np.abs(stamps[nearest] - at)
    if len(stamps) == 1:
        gap = np.maximum(stamps[0] - at, 0)
    far = gap > (LONGEST_HOLE - 1.0) * period
    if far.any():
        first = int(np.flatnonzero(far)[0])
        raise BagError(
            f"{where}: no closed flag for {int(far.sum())} of {len(at)} frames, first at {at[first] * 1e-9:.3f} s",
            got=f"the nearest one {gap[first] * 1e-6:.1f} ms away",
            next_step="Publish it at the rate of the poses, or once before the episode begins",
        )
    return flags[nearest]


def slerp(a: NDArray[np.float64], b: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (..., 4) between a (weight 0) and b (weight 1) the short way round. weight (...)."""
    cosine = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(cosine < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    w = np.broadcast_to(weight[..., None], angle.shape)
    small = sine < 1e-8  # the arc is a straight line to double precision
    safe = np.where(small, 1.0, sine)
    wa = np.where(small, 1.0 - w, np.sin((1.0 - w) * angle) / safe)
    wb = np.where(small, w, np.sin(w * angle) / safe)
    q = wa * a + wb * b
    return np.where(w == 0.0, a, q / np.linalg.norm(q, axis=-1, keepdims=True))

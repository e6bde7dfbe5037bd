"""What needs no grip: noise of the tracks, and clocks that stumble."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pred_core.types import Episode

UNEVEN = 0.2  # periods by which a frame may miss its time
LOST = 0.05  # share of frames in which nothing is measured
CALM = 0.1  # share of the frames the noise is read from


def noise_of(episodes: Sequence[Episode]) -> float:
    """Deviation of a coordinate of the tracks [m], from third differences in the calmest tenth of the frames.

    A third difference of white noise has variance 20 sigma^2; a smooth motion contributes little to it. Errors that
    change slowly do not show.
    """
    found = []
    for e in episodes:
        third = np.diff(np.where(e.tracks.visible[..., None], e.position, np.nan), n=3, axis=0)
        sizes = np.abs(third).reshape(len(third), third.shape[1] * 3)
        median = np.array([np.nanmedian(row) for row in sizes if np.isfinite(row).any()])
        if len(median):
            by_chance = 1.0 - 1.49 / np.sqrt(sizes.shape[1])  # the tenth quantile of such a median over its mean
            found.append(1.4826 * float(np.quantile(median, CALM)) / np.sqrt(20.0) / max(by_chance, 0.5))
    return float(np.median(found)) if found else 0.0


def clock_notes(episodes: Sequence[Episode]) -> list[str]:
    """What looks wrong with the stamps; empty if nothing does."""
    notes, uneven, lost = [], [], []
    for e in episodes:
        period = e.period * 1e9
        miss = np.diff(e.stamps) / period - 1.0
        if np.abs(miss).max() > UNEVEN:
            uneven.append((float(np.abs(miss).max()), e.name))
        unseen = float(1.0 - e.tracks.visible.any(axis=1).mean())
        if unseen > LOST:
            lost.append((unseen, e.name))
    if uneven:
        worst, name = max(uneven)
        notes.append(f"clock: {len(uneven)} episodes have uneven stamps, {name} misses one by {worst:.2f} periods")
    if lost:
        worst, name = max(lost)
        notes.append(f"clock: {len(lost)} episodes lost frames, {name} {worst:.0%} of them")
    periods = np.array([e.period for e in episodes])
    if np.ptp(periods) > 0.1 * np.median(periods):
        notes.append(f"clock: frames come every {1e3 * periods.min():.2f} to {1e3 * periods.max():.2f} ms")
    return notes

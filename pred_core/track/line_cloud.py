"""What the pictures of one instant say of a line: the points it is fitted to, and where they contradict it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pred_core.track.line_fit import SURFACE, Cloud, LineFit
from pred_core.track.line_start import FoundLine, LineStartConfig, find_line
from pred_core.track.view import View
from pred_core.types import Array

OBSTACLE = 0.015  # [m] before a node, beyond errors of depth and of the fit
SAME_TIME = 10_000_000  # [ns]


def newest(views: Sequence[View]) -> list[View]:
    """The views of the newest instant."""
    latest = max((v.stamp for v in views), default=0)
    return [v for v in views if latest - v.stamp < SAME_TIME]


def cloud_of(views: Sequence[View], stamp: int, radius: float, most: int) -> Cloud:
    """At most `most` points of each view, moved from the surface onto the centreline; ages count back from `stamp`."""
    picked = [v.select(np.arange(0, len(v.pixel), max(1, -(-len(v.pixel) // most)))) for v in views]
    rays = np.concatenate([v.rays for v in picked])
    return Cloud(
        np.concatenate([v.points for v in picked]) + SURFACE * radius * rays,
        rays,
        np.concatenate([v.depth for v in picked]),
        np.concatenate([np.full(len(v.pixel), i) for i, v in enumerate(picked)]),
        np.concatenate([np.full(len(v.pixel), (stamp - v.stamp) * 1e-9) for v in picked]),
    )


def find_in(views: Sequence[View], config: LineStartConfig) -> FoundLine | None:
    """The line in the points of all views, from scratch; None if there is none."""
    return find_line(np.concatenate([v.points for v in views]), np.concatenate([v.color for v in views]), config)


def near(view: View, nodes: Array, reach: float) -> View:
    """The points within the box around the nodes, `reach` [m] wider."""
    low, high = nodes.min(axis=0) - reach, nodes.max(axis=0) + reach
    keep = ((view.points >= low) & (view.points <= high)).all(axis=-1)
    return view if keep.all() else view.select(keep)


def contradicted(views: Sequence[View], fit: LineFit) -> float:
    """Share of the nodes where no camera sees the line although nothing stands before it."""
    found = np.zeros(len(fit.nodes), bool)
    for view in newest(views):  # an older picture may have been true
        found |= view.unobstructed(fit.nodes, OBSTACLE)
    return float((found & (fit.support == 0)).mean())

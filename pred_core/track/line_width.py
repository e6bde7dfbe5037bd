"""How thick a line object is, from how wide it looks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from pred_core.track.view import View
from pred_core.types import Array

WIDTH_OF_UNIFORM = np.sqrt(3.0)  # half width over standard deviation of points spread evenly over a width


def radius_of(views: Sequence[View], nodes: Array) -> float:
    """Radius [m] from how wide the line looks: half its width in the camera that sees most of it, from the spread."""
    along = np.gradient(nodes, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    widest = 0.0
    for view in views:
        if len(view.pixel) < 50:
            continue
        distance, near = cKDTree(nodes).query(view.points)
        across = np.cross(along[near], view.rays)
        size = np.linalg.norm(across, axis=-1)
        usable = (size > 0.3) & (distance < 0.03)
        if usable.sum() < 50:
            continue
        off = np.einsum("ma,ma->m", view.points - nodes[near], across)[usable] / size[usable]
        for index in np.unique(near[usable]):  # the rough path may run beside the middle
            at = near[usable] == index
            off[at] -= off[at].mean()
        widest = max(widest, float(WIDTH_OF_UNIFORM * off.std()))
    return widest

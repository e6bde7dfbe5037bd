"""Chamfer distances. The default is two-sided and unsquared; the others carry their own names."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pred_core.metrics.clouds import checked_cloud
from pred_core.types import Array


def chamfer_two_sided(a: Array, b: Array) -> float:
    """`chamfer_two_sided_unsquared` [m]: mean_p min_q |p-q| + mean_q min_p |p-q|. `a` (P, 3), `b` (Q, 3) [m].

    Source: the definition under which the paper's Table I is possible (CD above EMD in most cells).
    """
    return chamfer_one_sided(a, b) + chamfer_one_sided(b, a)


def chamfer_one_sided(a: Array, b: Array) -> float:
    """`chamfer_one_sided_unsquared` [m]: mean over `a` of the distance to the nearest point of `b`."""
    return float(_nearest(a, b).mean())


def chamfer_two_sided_squared(a: Array, b: Array) -> float:
    """`chamfer_two_sided_squared` [m^2]: the two-sided form with squared distances."""
    return float((_nearest(a, b) ** 2).mean() + (_nearest(b, a) ** 2).mean())


def _nearest(a: Array, b: Array) -> Array:
    tree = cKDTree(checked_cloud(b, "second cloud"))
    return np.asarray(tree.query(checked_cloud(a, "first cloud"))[0])

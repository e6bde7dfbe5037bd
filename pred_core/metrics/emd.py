"""Earth mover's distance between point clouds: minimum-cost matching."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from pred_core.metrics.clouds import checked_cloud
from pred_core.types import Array


def emd(a: Array, b: Array) -> float:
    """Mean unsquared distance of the minimum-cost matching (`emd`) [m].

    `a` (P, 3), `b` (Q, 3) [m]. Rectangular when P differs from Q: every point of the smaller cloud is
    matched once and the rest of the larger one stays unmatched. Raises: InputError for an empty or
    non-finite cloud.
    """
    cost = cdist(checked_cloud(a, "first cloud"), checked_cloud(b, "second cloud"))
    rows, columns = linear_sum_assignment(cost)
    return float(np.mean(cost[rows, columns]))

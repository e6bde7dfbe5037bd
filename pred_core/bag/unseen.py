"""Where the particles of a line are that no marker shows: the least bent curve through those that are measured.

Of all curves through the measured particles it is the one a uniform elastic rod takes that is bent little and loaded
nowhere between them: it minimises sum_b |k_b|^2 lbar_b with the curvature k_b = ((x_c - x_b)/l_b - (x_b - x_a)/l_a) /
lbar_b at every particle b between its neighbours a and c, edges l and lbar = (l_a + l_b)/2. This is the discrete
cubic spline of the line's own lengths. Two measured neighbours at an end give that end's direction. The curve is
linear in the measured positions, so that differences in time give its velocity too.

What a load between the measured particles adds is left out: a cantilever of length L whose end and end direction are
measured sags by w L^4 / (384 EI) at most between them, a 48th of the w L^4 / (8 EI) at its end.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import DatasetError
from pred_core.types import Array, Episode

KEY = "rest_length"  # of the data set's known facts: the N - 1 edges of the line [m]


def complete_line(episode: Episode, known: Mapping[str, Any]) -> Episode:
    """The episode with estimated positions where a particle of a line is never measured; it stays invisible.

    Only with the line's edges in `known`, and only particles that no frame of the episode shows: those hidden for a
    while keep their gaps. Frames in which a measured particle is hidden are not completed. Raises: DatasetError if
    the edges do not fit the particles, or fewer than two particles are measured.
    """
    edges = known.get(KEY)
    measured = np.asarray(episode.tracks.visible.any(axis=0))
    if episode.object.kind != "line" or not isinstance(edges, list) or measured.all():
        return episode
    if len(edges) != len(measured) - 1 or measured.sum() < 2:
        raise DatasetError(
            f"{episode.name}: particles that are never measured cannot be placed along the line",
            got=f"{len(edges)} edges in known {KEY}, {len(measured)} particles, {int(measured.sum())} of them measured",
            allowed=f"{len(measured) - 1} edges and two measured particles or more",
            next_step="Write confidence 0 for every id of the line that has no marker",
        )
    position = episode.position.copy()
    matrix = spline_matrix(np.asarray(edges, dtype=np.float64), measured)
    position[:, ~measured] = np.einsum("im,tmc->tic", matrix, position[:, measured])
    return dataclasses.replace(episode, tracks=dataclasses.replace(episode.tracks, position=position))


def spline_matrix(edges: Array, measured: NDArray[np.bool_]) -> Array:
    """(N - M, M): unseen positions from the M measured ones, for edges (N - 1,) [m] at rest."""
    count, inside = len(edges) + 1, np.arange(1, len(edges))
    lengths = 0.5 * (edges[:-1] + edges[1:])
    curvature = np.zeros((count - 2, count))
    curvature[inside - 1, inside - 1] = 1.0 / edges[:-1]
    curvature[inside - 1, inside + 1] = 1.0 / edges[1:]
    curvature[inside - 1, inside] = -1.0 / edges[:-1] - 1.0 / edges[1:]
    curvature /= np.sqrt(lengths)[:, None]
    solution, *_ = np.linalg.lstsq(curvature[:, ~measured], -curvature[:, measured], rcond=None)
    return np.asarray(solution, dtype=np.float64)

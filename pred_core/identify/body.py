"""The Body a data set implies: particles, lengths, mass, gravity; nothing is searched here."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pred_core.bag.dataset import Dataset
from pred_core.errors import DatasetError
from pred_core.identify.config import IdentifyConfig
from pred_core.springmass.topology import build_body
from pred_core.types import Array, Body, Episode, Physics, Scene

WIDEST = 4.0  # times the median distance of neighbours: the longest spring searched


@dataclasses.dataclass(frozen=True)
class Layout:
    """A body before its springs are chosen, and what bounds them."""

    body: Body
    scene: Scene
    shortest: float  # [m] connection threshold below which a particle comes loose
    longest: float  # [m] largest connection threshold searched
    mass_known: bool


def lay_out(dataset: Dataset, episodes: Sequence[Episode], config: IdentifyConfig, noise: float = 0.0) -> Layout:
    """Particles at rest: a line is laid out straight with its median edge lengths, others as first seen.

    `noise` [m] of the tracks: edges are freed of what it adds to them.
    Raises: DatasetError if episodes differ in particles, or particles that the rest shape needs are not seen.
    """
    ids = episodes[0].tracks.id
    for episode in episodes:
        if not np.array_equal(episode.tracks.id, ids):
            raise DatasetError(
                f"{episode.name}: particle ids differ from {episodes[0].name}",
                got=_ids(episode.tracks.id),
                allowed=_ids(ids),
                next_step="Split the data set by object",
            )
    kind = dataset.object.kind
    edges = _edges(episodes, noise) if kind == "line" else None
    rest = _first_shape(episodes) if edges is None else _straight(edges)
    spacing = _neighbour_distances(rest)
    shortest = 1.001 * float(edges.max() if edges is not None else spacing.max())
    mass = dataset.known.get("mass")
    physics = dataclasses.replace(Physics(), connection_threshold=shortest, max_springs=2 if edges is not None else 8)
    radius = float(dataset.known.get("radius", 0.0)) if config.radius is None else config.radius
    ground = dataset.known.get("ground") if config.ground is None else config.ground
    body = build_body(kind, rest, float(mass or config.mass), physics, id=ids, rest_length=edges, radius=radius)
    body = dataclasses.replace(body, surface=np.any([e.tracks.visible.any(axis=0) for e in episodes], axis=0))
    scene = Scene(gravity=dataset.gravity, ground=None if ground is None else float(ground))
    return Layout(body, scene, shortest, max(WIDEST * float(np.median(spacing)), 1.01 * shortest), mass is not None)


def _edges(episodes: Sequence[Episode], noise: float) -> Array:
    """(N-1,) [m] median distance of consecutive particles over all frames.

    Noise across an edge makes it longer: both ends have `noise` in two directions, l^2 + 4 noise^2.
    """
    lengths = np.concatenate([np.linalg.norm(np.diff(e.position, axis=1), axis=2) for e in episodes])
    ids = episodes[0].tracks.id
    never = np.flatnonzero(~np.isfinite(lengths).any(axis=0))
    if len(never):
        raise DatasetError(
            "neighbours on the line are never seen together",
            got=", ".join(f"{ids[i]} and {ids[i + 1]}" for i in never[:3].tolist()),
            next_step="Leave out particles that are not tracked",
        )
    median = np.asarray(np.nanmedian(lengths, axis=0), dtype=np.float64)
    return np.sqrt(np.maximum(median**2 - 4.0 * noise**2, (0.5 * median) ** 2))


def _straight(edges: Array) -> Array:
    """(N, 3) [m] a line along x with these edges."""
    rest = np.zeros((len(edges) + 1, 3))
    rest[1:, 0] = np.cumsum(edges)
    return rest


def _first_shape(episodes: Sequence[Episode]) -> Array:
    """(N, 3) [m] the first frame of the first episode whose first frame shows every particle."""
    for episode in episodes:
        if np.isfinite(episode.position[0]).all():
            return episode.position[0].copy()
    unseen = ~np.isfinite(episodes[0].position[0]).all(axis=-1)
    raise DatasetError(
        "no episode shows every particle at its first frame, which gives the rest shape",
        got=f"{episodes[0].name} lacks {_ids(episodes[0].tracks.id[unseen])}",
        next_step="Record an episode that begins with the object at rest in full view",
    )


def _ids(ids: NDArray[np.uint32]) -> str:
    shown = ", ".join(map(str, ids[:5].tolist()))
    return f"{len(ids)} particles ({shown}{', ...' if len(ids) > 5 else ''})"


def _neighbour_distances(position: Array) -> Array:
    """(N,) [m] to the nearest other particle."""
    distance, _ = cKDTree(position).query(position, k=2)
    return np.asarray(distance[:, 1], dtype=np.float64)

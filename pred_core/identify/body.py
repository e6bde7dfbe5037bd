"""The Body a data set implies: particles, lengths, mass, gravity; nothing is searched here."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

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


def lay_out(dataset: Dataset, episodes: Sequence[Episode], config: IdentifyConfig) -> Layout:
    """Particles at rest: a line is laid out straight with its median edge lengths, others as first seen.

    Raises: DatasetError if episodes differ in particles or some particle is never seen at a first frame.
    """
    ids = episodes[0].tracks.id
    for episode in episodes:
        if not np.array_equal(episode.tracks.id, ids):
            raise DatasetError(
                f"{episode.name}: particle ids differ from {episodes[0].name}", got=f"{len(episode.tracks.id)} particles",
                allowed=f"{len(ids)}", next_step="Split the data set by object",
            )
    kind = dataset.object.kind
    if kind == "line":
        lengths = np.concatenate([np.linalg.norm(np.diff(e.position, axis=1), axis=2) for e in episodes])
        edges = np.nanmedian(lengths, axis=0)
        rest = np.zeros((len(ids), 3))
        rest[1:, 0] = np.cumsum(edges)
    else:
        rest, edges = episodes[0].position[0].copy(), None
    if not np.isfinite(rest).all():
        raise DatasetError(f"{episodes[0].name}: a particle is not seen at the first frame",
                           next_step="Start the data set with an episode whose first frame shows every particle")
    spacing = _neighbour_distances(rest)
    shortest = 1.001 * float(edges.max() if edges is not None else spacing.max())
    mass = dataset.known.get("mass")
    physics = dataclasses.replace(Physics(), connection_threshold=shortest, max_springs=2 if edges is not None else 8)
    body = build_body(
        kind, rest, float(mass or config.mass), physics, id=ids, rest_length=edges, radius=config.radius
    )
    scene = Scene(gravity=dataset.gravity, ground=config.ground)
    return Layout(body, scene, shortest, max(WIDEST * float(np.median(spacing)), 1.01 * shortest), mass is not None)


def _neighbour_distances(position: Array) -> Array:
    distance = np.linalg.norm(position[:, None] - position[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return distance.min(axis=1)

"""Held particles at a start: in the jaws where the twin knows them to sit, unless the tracks say that they are not.

Two particles in the jaws, 2 cm apart, seen with an error of 2 mm each, would turn the clamp by 8 degrees for good. But
one that is put into the jaws though the tracks have it half a metre away tears the springs beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from pred_core.frames import quaternion_rotate
from pred_core.types import Array, Body, Grip, State

Levers = Mapping[int, Sequence[float]]  # particle index -> place in its gripper's frame (3,) [m]

STRETCH = 1.1  # no object is longer than so many times its rest length


class Grasp:
    """Who is to be held (N,), -1: nobody, and where in its gripper's frame (N, 3) [m]."""

    def __init__(self, body: Body, state: State, grip: Grip, levers: Levers):
        """What `state` holds, with the gripper at the same time; a lever goes before the place in the state."""
        self._gripper: NDArray[np.int64] = state.held.numpy().astype(np.int64)
        self._index = np.flatnonzero(self._gripper >= 0)
        frame = torch.from_numpy(self._gripper[self._index])
        position, rotation = grip.position[frame], grip.rotation[frame]
        back = rotation * torch.tensor([1.0, -1.0, -1.0, -1.0])
        self._place = quaternion_rotate(back, state.position[torch.from_numpy(self._index)] - position)
        for k, particle in enumerate(self._index.tolist()):
            if particle in levers:
                self._place[k] = torch.as_tensor(levers[particle], dtype=torch.float32)
        self._away = _along(body, self._index)

    def taken(self, state: State, grip: Grip, track: Array, slipped: float) -> State:
        """`state` with the held ones in the jaws of `grip`, and those free that the tracks (N, 3) [m], NaN where not
        seen, contradict: seen more than `slipped` [m] off; or not seen, and what is seen beside them too far to reach.
        """
        gripper = self._gripper[self._index]
        frame = torch.from_numpy(gripper)
        place = grip.position[frame] + quaternion_rotate(grip.rotation[frame], self._place)
        keeps = grip.closed[frame].numpy() & (self._off(place.double().numpy(), track) <= slipped)
        position, held = state.position.clone(), torch.full_like(state.held, -1)
        kept = torch.from_numpy(self._index[keeps])
        position[kept] = place[torch.from_numpy(keeps)].to(position.dtype)
        held[kept] = torch.from_numpy(gripper[keeps]).to(held.dtype)
        return state.replace(position=position, held=held)

    def missing(self, state: State, grip: Grip) -> int:
        """How many it has, of grippers that are closed, that `state` does not hold."""
        closed = grip.closed.numpy()[self._gripper[self._index]]
        return int((closed & (state.held.numpy()[self._index] < 0)).sum())

    def _off(self, place: Array, track: Array) -> Array:
        """(H,) [m] by how much each place is farther from the nearest seen particle than the object reaches."""
        seen = np.flatnonzero(np.isfinite(track).all(axis=1))
        if not len(seen):
            return np.zeros(len(place))
        nearest = seen[self._away[:, seen].argmin(axis=1)]
        reach = STRETCH * self._away[np.arange(len(place)), nearest]
        return np.maximum(np.linalg.norm(track[nearest] - place, axis=1) - reach, 0.0)


def _along(body: Body, sources: NDArray[np.int64]) -> Array:
    """(H, N) [m] rest length along the springs from each of `sources`."""
    first, second = body.springs.T
    graph = csr_array((body.rest_length, (first, second)), shape=(body.count, body.count))
    return np.asarray(dijkstra(graph, directed=False, indices=sources)).reshape(len(sources), body.count)

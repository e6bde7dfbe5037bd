"""Held particles at a start: in the jaws where the twin knows them to sit, unless the tracks say that they are not.

Two particles in the jaws, 2 cm apart, seen with an error of 2 mm each, would turn the clamp by 8 degrees for good. But
one that is put into the jaws though the tracks have it half a metre away tears the springs beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from pred_core.frames import quaternion_rotate
from pred_core.types import Array, Body, Grip, State

Levers = Mapping[int, Sequence[float]]  # particle index -> place in its gripper's frame (3,) [m]

STRETCH = 1.1  # no object is longer than so many times its rest length


@dataclass(frozen=True)
class Grasp:
    """Particles that are to be held."""

    index: NDArray[np.int64]  # (H,) particle
    gripper: NDArray[np.int64]  # (H,)
    place: torch.Tensor  # (H, 3) [m] in the gripper's frame
    away: Array  # (H, N) [m] of each particle along the springs, at rest

    def taken(self, state: State, grip: Grip, track: Array, slipped: float) -> State:
        """`state` with them in the jaws of `grip`, and those free that the tracks (N, 3) [m], NaN where not seen,
        contradict: seen more than `slipped` [m] off; or not seen, and what is seen beside them too far to reach.
        """
        frame = torch.from_numpy(self.gripper)
        place = grip.position[frame] + quaternion_rotate(grip.rotation[frame], self.place)
        keeps = grip.closed[frame].numpy() & (self._off(place.double().numpy(), track) <= slipped)
        position, held = state.position.clone(), torch.full_like(state.held, -1)
        kept = torch.from_numpy(self.index[keeps])
        position[kept] = place[torch.from_numpy(keeps)].to(position.dtype)
        held[kept] = torch.from_numpy(self.gripper[keeps]).to(held.dtype)
        return state.replace(position=position, held=held)

    def kept(self, grip: Grip) -> Grasp:
        """Without those whose gripper has opened: what it takes when it closes again is another grasp."""
        closed = grip.closed.numpy()[self.gripper]
        if closed.all():
            return self
        return Grasp(self.index[closed], self.gripper[closed], self.place[torch.from_numpy(closed)], self.away[closed])

    def joined(self, body: Body, state: State, grip: Grip) -> Grasp:
        """With what `state` holds besides."""
        mine = torch.from_numpy(self.index)
        held = state.held.clone()
        held[mine] = torch.from_numpy(self.gripper).to(held.dtype)
        levers = dict(zip(self.index.tolist(), self.place.tolist(), strict=True))
        return grasp_of(body, state.replace(held=held), grip, levers)

    def missing(self, state: State) -> int:
        """How many of them `state` does not hold."""
        return int((state.held.numpy()[self.index] < 0).sum())

    def _off(self, place: Array, track: Array) -> Array:
        """(H,) [m] by how much each place is farther from the nearest seen particle than the object reaches."""
        seen = np.flatnonzero(np.isfinite(track).all(axis=1))
        if not len(seen):
            return np.zeros(len(place))
        nearest = seen[self.away[:, seen].argmin(axis=1)]
        reach = STRETCH * self.away[np.arange(len(place)), nearest]
        return np.maximum(np.linalg.norm(track[nearest] - place, axis=1) - reach, 0.0)


def grasp_of(body: Body, state: State, grip: Grip, levers: Levers) -> Grasp:
    """What `state` holds, with the gripper at the same time; a lever goes before the place in the state."""
    index = np.flatnonzero(state.held.numpy() >= 0)
    gripper = state.held.numpy()[index].astype(np.int64)
    frame = torch.from_numpy(gripper)
    back = grip.rotation[frame] * torch.tensor([1.0, -1.0, -1.0, -1.0])
    place = quaternion_rotate(back, state.position[torch.from_numpy(index)] - grip.position[frame])
    for k, particle in enumerate(index.tolist()):
        if particle in levers:
            place[k] = torch.as_tensor(levers[particle], dtype=torch.float32)
    return Grasp(index, gripper, place, _along(body, index))


def _along(body: Body, sources: NDArray[np.int64]) -> Array:
    """(H, N) [m] rest length along the springs from each of `sources`."""
    first, second = body.springs.T
    graph = csr_array((body.rest_length, (first, second)), shape=(body.count, body.count))
    return np.asarray(dijkstra(graph, directed=False, indices=sources)).reshape(len(sources), body.count)

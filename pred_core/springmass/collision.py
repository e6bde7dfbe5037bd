"""Which particle pairs may touch within the next period (optional self-collision)."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree
from torch import Tensor

from pred_core.types import Body, Grip, State

NEAR_RINGS = 3  # springs away along the object within which particles never collide


def candidate_pairs(body: Body, near: csr_matrix, state: State, before: Grip, grips: Grip, period: float) -> Tensor:
    """(C, 2) int32 pairs that could come within two radii in the first `period` [s], over all worlds.

    Speeds are taken from the state (W, N, 3) and from the grippers' way; a radius a particle is left for what
    they gain within the period. Pairs of `near` (`connected_within`) and worlds that diverged are left out.
    """
    alive = torch.isfinite(state.position + state.velocity).all(-1).all(-1)
    position, velocity = state.position[alive], state.velocity[alive]
    speed = float(velocity.norm(dim=-1).max()) if velocity.numel() else 0.0
    if grips.position.numel():
        speed = max(speed, float((grips.position[0] - before.position).norm(dim=-1).max()) / period)
    reach = 4.0 * body.radius + 2.0 * speed * period
    found = [cKDTree(world).query_pairs(reach, output_type="ndarray") for world in position.cpu().double().numpy()]
    pairs = np.unique(np.sort(np.concatenate(found), axis=1), axis=0) if found else np.zeros((0, 2), dtype=np.int64)
    if len(pairs):
        pairs = pairs[np.asarray(near[pairs[:, 0], pairs[:, 1]]).ravel() == 0]
    return torch.as_tensor(pairs.astype(np.int32), device=position.device)


def connected_within(body: Body, rings: int = NEAR_RINGS) -> csr_matrix:
    """Sparse (N, N), nonzero where two particles are at most `rings` springs apart."""
    s = body.springs
    ones = np.ones(len(s))
    one = coo_matrix((ones, (s[:, 0], s[:, 1])), shape=(body.count, body.count)).tocsr()
    one = one + one.T
    reach = one
    for _ in range(rings - 1):
        reach = reach + reach @ one
    return reach.tocsr()

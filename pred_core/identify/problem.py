"""Rolling candidates out over fixed windows, candidates and windows as one batch of worlds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.effects import effect_of
from pred_core.identify.space import Candidate
from pred_core.identify.topology import Topology
from pred_core.identify.windows import Windows
from pred_core.springmass import SpringMass
from pred_core.springmass.arrays import mass_of_worlds
from pred_core.springmass.parameters import added_by
from pred_core.springmass.stability import demand
from pred_core.types import Array, Body, Grip, Physics, Scene, State

DIVERGED = 1.0  # [m] the error a world counts with from where it is not finite
MOST_WORLDS = 2048  # in one kernel call
MOST_NUMBERS = 20_000_000  # of a trajectory in one kernel call; bounds memory
MOST_PARTICLES = 128  # whose residuals a refinement reads; more are close to each other
# A period's substeps come from a coarse ladder: candidates that share a rung share a call, and what one candidate
# costs does not depend on the others in its generation.
RUNGS = tuple(sorted({b << k for b in (2, 3) for k in range(14)} | {1}))


class Problem:
    """Losses of candidates on windows.

    `most_substeps` bounds stiffness: a candidate that needs more is not simulated but charged `DIVERGED` and how far
    it is beyond, so that a search returns from there. So is one whose springs leave particles loose. A candidate that
    needs up to `room` times as many is simulated with `most_substeps`.
    """

    def __init__(
        self,
        body: Body,
        scene: Scene,
        period: float,
        windows: Windows,
        most_substeps: int,
        topology: Topology | None = None,
        room: float = 1.0,
    ):
        self.body, self.scene, self.period, self.windows = body, scene, period, windows
        self.most_substeps, self.topology, self.room = most_substeps, topology, room
        always = (windows.start.held >= 0).all(dim=0) & (windows.held >= 0).flatten(0, 1).all(dim=0)
        self.held: NDArray[np.bool_] = always.numpy()  # (N,) particles that never move freely
        free = np.flatnonzero(~self.held)
        self._read = torch.as_tensor(free[:: -(-max(len(free), 1) // MOST_PARTICLES)])
        # Each seen coordinate's share of its window's mean, (K, W, N, 1).
        seen = windows.seen.float()
        self._share = (seen / (3.0 * seen.sum(dim=(0, 2), keepdim=True)).clamp_min(1.0))[..., None]

    def demand(self, candidate: Candidate) -> float:
        """Substeps a period that keep this candidate stable (`springmass.stability`), neither rounded nor limited."""
        body = self.body if self.topology is None else self.topology.body(candidate.physics)
        effects = tuple(effect_of(e) for e in candidate.extensions)
        mass = None
        if any("inertia" in e.hooks for e in effects):
            mass = mass_of_worlds(body, [candidate.extensions], effects)[0].double().numpy()
        return demand(body, self.period, candidate.physics, added_by(body, candidate.extensions), self.held, mass)

    def substeps(self, candidate: Candidate) -> int:
        """What this candidate is simulated with, a rung; what it needs if that is beyond `most_substeps`."""
        needed = max(1, math.ceil(self.demand(candidate)))
        if needed > self.room * self.most_substeps:
            return needed
        return min(next((r for r in RUNGS if r >= needed), needed), self.most_substeps)

    def losses(self, candidates: Sequence[Candidate], substeps: int | None = None) -> Array:
        """(C, W) mean absolute error per coordinate [m] of free particles, over the window.

        `substeps`: the same for all candidates, so that small differences are theirs; None: what each needs.
        """
        result = np.full((len(candidates), self.windows.count), DIVERGED)
        for part, steps in self._calls(candidates, result, substeps):
            error = self._errors([candidates[n] for n in part], steps, 1).abs_()
            if not bool(torch.isfinite(error.sum())):
                error = torch.where(torch.isfinite(error), error, DIVERGED)
            total = error.clamp_(max=DIVERGED).mul_(self._share[:, None]).sum(dim=(0, 3, 4))
            result[part] = total.double().numpy()
        return result

    def residuals(
        self, candidates: Sequence[Candidate], stride: int, substeps: int | None = None
    ) -> NDArray[np.float32]:
        """(C, W, R) signed errors [m] of free particles at every `stride`-th step.

        Unseen entries are zero, diverged ones `DIVERGED`. `substeps` as for `losses`.
        """
        seen = self.windows.seen[stride - 1 :: stride][:, :, self._read]
        if not len(seen):
            raise ValueError(f"stride {stride} is longer than the windows")
        size = seen.shape[0] * seen.shape[2] * 3
        worst = np.full((len(candidates), 1), DIVERGED)
        result = np.full((len(candidates), self.windows.count, size), DIVERGED, dtype=np.float32)
        for part, steps in self._calls(candidates, worst, substeps):
            error = self._errors([candidates[n] for n in part], steps, stride)[:, :, :, self._read]
            error = torch.where(torch.isfinite(error), error, DIVERGED).clamp_(-DIVERGED, DIVERGED)
            error = torch.where(seen[:, None, ..., None], error, 0.0).movedim(0, 2)
            result[part] = error.reshape(len(part), self.windows.count, size).numpy()
        return result

    def _calls(
        self, candidates: Sequence[Candidate], charged: Array, substeps: int | None
    ) -> Iterator[tuple[list[int], int]]:
        """(candidate indices, substeps) of each kernel call; rows of `charged` that are not simulated are filled in."""
        needed = np.array([self.substeps(c) for c in candidates])
        beyond = needed > self.most_substeps
        charged[beyond] = DIVERGED * (needed[beyond, None] / self.most_substeps)
        if self.topology is not None:
            loose = np.array([self.topology.loose(c.physics) for c in candidates])
            charged[loose > 0] = DIVERGED * (1.0 + loose[loose > 0, None])
            beyond |= loose > 0
        if substeps is not None:
            needed[:] = max(substeps, 1)
        numbers = self.windows.target[:, 0].numel() * self.windows.count
        most = max(1, min(MOST_WORLDS // self.windows.count, MOST_NUMBERS // numbers))
        for steps in np.unique(needed[~beyond]).tolist():
            members = np.flatnonzero(~beyond & (needed == steps)).tolist()
            yield from ((members[n : n + most], steps) for n in range(0, len(members), most))

    def _errors(self, candidates: Sequence[Candidate], substeps: int, stride: int) -> Tensor:
        """(K/stride, C, W, N, 3) prediction minus target."""
        w, count = self.windows, len(candidates)
        body, mask = self.body, None
        if self.topology is not None:
            body, mask = self.topology.shared([c.physics for c in candidates], w.count)
        physics: list[Physics] = [c.physics for c in candidates for _ in range(w.count)]
        extended = any(c.extensions for c in candidates)
        simulator = SpringMass(
            body,
            physics,
            self.scene,
            period=self.period,
            substeps=substeps,
            extensions=[c.extensions for c in candidates for _ in range(w.count)] if extended else (),
            spring_mask=mask,
            diverged_as_nan=True,
        )
        s, g = w.start, w.start_grip
        state = State(_tile(s.position, count), _tile(s.velocity, count), _tile(s.held, count))
        start = simulator.start(
            state, Grip(_tile(g.position, count), _tile(g.rotation, count), _tile(g.closed, count))
        )
        g = w.grips
        grips = Grip(g.position.repeat(1, count, 1, 1), g.rotation.repeat(1, count, 1, 1), g.closed.repeat(1, count, 1))
        positions = simulator.rollout(start, grips)[stride - 1 :: stride]
        return positions.unflatten(1, (count, w.count)) - w.target[stride - 1 :: stride][:, None]


def _tile(values: Tensor, count: int) -> Tensor:
    """(W, ...) repeated to (count * W, ...)."""
    return values.repeat(count, *[1] * (values.dim() - 1))

"""Rolling candidates over a sample: one batch of worlds for all candidates with the same effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.diagnose.sample import Sample
from pred_core.effects import effect_of, find_effect
from pred_core.identify.space import Candidate
from pred_core.springmass import SpringMass
from pred_core.springmass.arrays import mass_of_worlds
from pred_core.springmass.parameters import added_by
from pred_core.springmass.stability import demand
from pred_core.twin import Twin
from pred_core.types import Grip, State

FARTHEST = 0.5  # [m] a coordinate's error counts with at most; also where the simulation is not finite
NEAR = 0.01  # [m]
MOST_WORLDS = 1536  # in one kernel call
LADDER = (1.0, 1.15, 1.35, 1.6, 2.0, 2.5, 3.2, 4.0, 6.0, 9.0, 12.0)  # times the twin's substeps: what candidates get
PACE = 0.65  # of the substeps that keep half the stability limit: moves a prediction by 0.06 mm at most on average
MOST_FACTOR = 4.0  # what is stiffer than that is simulated with so many: the bound is far on the safe side
MOST_LOSS = LADDER[-1]  # the same for a loss in bending, whose bound is nearer
LOSS = "internal loss"  # family


@dataclass(frozen=True)
class Roller:
    """The twin's body and scene over the windows of one sample."""

    twin: Twin
    sample: Sample

    def demand(self, candidate: Candidate) -> float:
        """Substeps a period that keep this candidate stable."""
        body = self.twin.body
        effects = tuple(effect_of(e) for e in candidate.extensions)
        mass = None
        if any("inertia" in e.hooks for e in effects):
            mass = mass_of_worlds(body, [candidate.extensions], effects)[0].double().numpy()
        held = (self.sample.windows.start.held >= 0).all(dim=0).numpy()
        added = added_by(body, candidate.extensions)
        return demand(body, self.twin.meta.period, candidate.physics, added, held, mass)

    def substeps(self, candidates: Sequence[Candidate]) -> int:
        """One number for all: PACE of the most demanding one's, a rung, at least of the twin's own, within reason."""
        usual = self.usual()
        most = MOST_LOSS if any(map(self._loses_otherwise, candidates)) else MOST_FACTOR
        needed = min(max(self.demand(c) for c in candidates) / usual, most)
        return math.ceil(PACE * usual * next(f for f in LADDER if f >= needed))

    def _loses_otherwise(self, candidate: Candidate) -> bool:
        mine = {e.id: e.parameters for e in self.twin.extensions}
        return any(find_effect(e.id).family == LOSS and mine.get(e.id) != e.parameters for e in candidate.extensions)

    def usual(self) -> float:
        """Substeps a period that keep the twin as it is stable."""
        return self.demand(Candidate(self.twin.physics, self.twin.extensions))

    def errors(self, candidates: Sequence[Candidate], stride: int = 1, substeps: int | None = None) -> Tensor:
        """(C, W, K, N, 3) [m] predicted minus measured at every `stride`-th frame; 0 where not seen.

        All candidates must have the same effects. Not finite or farther than FARTHEST: FARTHEST.
        """
        steps = substeps or self.substeps(candidates)
        most = max(1, MOST_WORLDS // self.sample.windows.count)
        parts = [self._roll(candidates[n : n + most], stride, steps) for n in range(0, len(candidates), most)]
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    def positions(self, candidate: Candidate) -> Tensor:
        """(W, K, N, 3) [m] predicted."""
        w = self.sample.windows
        raw = self._errors([candidate], self.substeps([candidate]))[:, 0] + w.target
        return raw.movedim(0, 1)

    def _roll(self, candidates: Sequence[Candidate], stride: int, substeps: int) -> Tensor:
        w = self.sample.windows
        error = self._errors(candidates, substeps)[stride - 1 :: stride]
        error = torch.where(torch.isfinite(error), error, FARTHEST).clamp_(-FARTHEST, FARTHEST)
        seen = w.seen[stride - 1 :: stride][:, None, ..., None]
        return torch.where(seen, error, 0.0).permute(1, 2, 0, 3, 4).contiguous()

    def _errors(self, candidates: Sequence[Candidate], substeps: int) -> Tensor:
        """(K, C, W, N, 3), windows in the sample's order."""
        effects = [find_effect(e.id) for e in candidates[0].extensions]
        remembers = any(e.bend_memory for e in effects)
        orders = np.unique(self.sample.order).tolist() if remembers else [0]  # of some windows, not all are there
        result: Tensor | None = None
        memory: dict[int, Tensor] = {}  # episode -> (C, M + 1) what the laws remember, and steps
        for order in orders:
            every = np.arange(self.sample.windows.count, dtype=np.int64)
            keep = np.flatnonzero(self.sample.order == order).astype(np.int64) if remembers else every
            part, left = self._call(candidates, substeps, keep, memory)
            if result is None:
                result = part.new_empty(part.shape[0], len(candidates), self.sample.windows.count, *part.shape[3:])
            result[:, :, torch.as_tensor(keep)] = part
            if remembers:
                for column, e in enumerate(self.sample.episode[keep].tolist()):
                    memory[e] = left[:, column]
        assert result is not None
        return result

    def _call(
        self, candidates: Sequence[Candidate], substeps: int, keep: NDArray[np.int64], memory: dict[int, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """One kernel call over some windows: errors (K, C, W', N, 3), memory and steps after it (C, W', M + 1)."""
        w, count, twin = self.sample.windows, len(candidates), self.twin
        rows = torch.as_tensor(keep)
        width = len(rows)
        extended = any(c.extensions for c in candidates)
        simulator = SpringMass(
            twin.body,
            [c.physics for c in candidates for _ in range(width)],
            twin.scene,
            period=twin.meta.period,
            substeps=substeps,
            extensions=[c.extensions for c in candidates for _ in range(width)] if extended else (),
            diverged_as_nan=True,
        )
        s, g = w.start, w.start_grip
        position, velocity, held = (_tile(v[rows], count) for v in (s.position, s.velocity, s.held))
        state = State(position, velocity, held)
        grip = Grip(*(_tile(v[rows], count) for v in (g.position, g.rotation, g.closed)))
        state = simulator.start(state, grip)
        carried = dict(state.memory)
        known = [memory.get(e) for e in self.sample.episode[keep].tolist()]
        if any(k is not None for k in known):  # what is carried follows the steps it took: a law's clock and memory
            fresh = torch.cat((carried["effects"], carried["steps"][:, None]), dim=1).unflatten(0, (count, width))
            columns = [fresh[:, n] if k is None else torch.where(k.isfinite(), k, 0.0) for n, k in enumerate(known)]
            both = torch.stack(columns, dim=1).flatten(0, 1)
            slides = simulator.grip_memory_size
            both[:, both.shape[1] - 1 - slides : -1] = 0.0  # begins anew: the measured start has what slid before
            carried["effects"], carried["steps"] = both[:, :-1].contiguous(), both[:, -1].contiguous()
        carried["time"] = _tile(self.sample.time[rows], count) - carried["steps"] * twin.meta.period
        p = w.grips
        grips = Grip(*(v[:, rows].repeat(1, count, *[1] * (v.dim() - 2)) for v in (p.position, p.rotation, p.closed)))
        positions, after = simulator.rollout_states(state.replace(memory=carried), grips)
        error = positions.unflatten(1, (count, width)) - w.target[:, rows][:, None]
        left = torch.cat((after.memory["effects"], after.memory["steps"][:, None]), dim=1)
        return error, left.unflatten(0, (count, width))


def on_ground(roller: Roller) -> NDArray[np.bool_]:
    """(E,) whether an episode touches the ground: a tenth of what was seen lies within NEAR of it."""
    sample, ground = roller.sample, roller.twin.scene.ground
    if ground is None:
        return np.zeros(sample.episodes, dtype=bool)
    w = sample.windows
    low = (w.target[..., 2] < ground + roller.twin.body.radius + NEAR) & w.seen
    share = low.sum(dim=(0, 2)) / w.seen.sum(dim=(0, 2)).clamp_min(1)
    return np.asarray(sample.per_episode(share.double().numpy()) > 0.1)


def _tile(values: Tensor, count: int) -> Tensor:
    """(W, ...) repeated to (count * W, ...)."""
    return values.repeat(count, *[1] * (values.dim() - 1))

"""Rolling candidates out over fixed windows, all candidates and windows as one batch of worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.effects import find_effect
from pred_core.errors import DatasetError
from pred_core.identify.space import Candidate
from pred_core.identify.starts import estimate_start
from pred_core.identify.topology import Topology
from pred_core.springmass import SpringMass
from pred_core.springmass.stability import choose_substeps
from pred_core.train.recordings import Recording, gather, window_index
from pred_core.types import Array, Body, Grip, Scene, State

DIVERGED = 1.0  # [m] the error a world counts with from where it is not finite
MOST_WORLDS = 2048  # in one kernel call; bounds memory


@dataclass(frozen=True)
class Windows:
    """W windows of K periods: estimated starts, gripper poses, targets."""

    start: State  # (W, N, 3)
    start_grip: Grip  # (W, G, ...)
    grips: Grip  # (K, W, G, ...)
    target: Tensor  # (K, W, N, 3) [m] world
    seen: Tensor  # (K, W, N) bool, free particles that were measured
    names: tuple[str, ...]  # (W,) episode of each window

    @property
    def count(self) -> int:
        """Number of windows W."""
        return len(self.names)


def make_windows(
    recordings: Sequence[Recording], index: Tensor, steps: int, period: float, noise: float | None
) -> Windows:
    """The windows `index` (W, 2). `noise` [m]: starts are estimated with it; None: raw from two frames."""
    batch = gather(recordings, index, steps, period, torch.device("cpu"))
    start = batch.start
    if noise is not None:
        estimates = [estimate_start(recordings[r], f, period, noise) for r, f in index.tolist()]
        start = start.replace(
            position=torch.stack([e[0] for e in estimates]), velocity=torch.stack([e[1] for e in estimates])
        )
    free = (start.held < 0)[None]
    names = tuple(recordings[r].name for r, _ in index.tolist())
    return Windows(start, batch.start_grip, batch.grips, batch.target, batch.seen & free, names)


def draw_windows(
    recordings: Sequence[Recording], steps: int, count: int, generator: torch.Generator
) -> Tensor:
    """(W, 2) recording and start frame: at most `count` windows, spread over recordings, the same for a seed."""
    if not recordings:
        raise DatasetError("no recordings to draw windows from")
    steps = min(steps, max(len(r.position) for r in recordings) - 2)
    index = window_index(recordings, steps, max(steps // 2, 1))
    order = torch.randperm(len(index), generator=generator)
    taken: dict[int, int] = {}
    ranked = []
    for n in order.tolist():
        r = int(index[n, 0])
        ranked.append((taken.get(r, 0), len(ranked), n))
        taken[r] = taken.get(r, 0) + 1
    chosen = sorted(n for _, _, n in sorted(ranked)[:count])
    return index[chosen]


class Problem:
    """Losses of candidates on windows.

    `most_substeps` bounds stiffness: a candidate that needs more is not simulated but charged `DIVERGED` and how far
    it is beyond, so that a search returns from there. So is one whose springs leave particles loose.
    """

    def __init__(
        self, body: Body, scene: Scene, period: float, windows: Windows, most_substeps: int,
        topology: Topology | None = None,
    ):
        self.body, self.scene, self.period, self.windows = body, scene, period, windows
        self.most_substeps, self.topology = most_substeps, topology
        self.held = (windows.start.held >= 0).all(dim=0).numpy()

    def substeps(self, candidate: Candidate) -> int:
        """What stability asks for this candidate."""
        body = self.body if self.topology is None else self.topology.body(candidate.physics)
        return choose_substeps(body, self.period, [candidate.physics], [_bend_bound(candidate)], held=self.held)

    def losses(self, candidates: Sequence[Candidate]) -> Array:
        """(C, W) mean absolute error per coordinate [m] of free particles, over the window."""
        result = np.full((len(candidates), self.windows.count), DIVERGED)
        good = self._admissible(candidates, result)
        per_call = max(1, MOST_WORLDS // self.windows.count)
        for begin in range(0, len(good), per_call):
            part = good[begin : begin + per_call]
            error = self._errors([candidates[n] for n in part])
            seen = self.windows.seen[:, None, :, :, None]
            error = torch.where(seen & torch.isfinite(error), error.abs(), torch.where(seen, DIVERGED, 0.0))
            total = error.clamp_max(DIVERGED).sum(dim=(0, 3, 4)) / (3.0 * self.windows.seen.sum(dim=(0, 2))[None])
            result[part] = total.double().numpy()
        return result

    def residuals(self, candidates: Sequence[Candidate], stride: int) -> Array:
        """(C, W, R) signed errors [m] at every `stride`-th step; unseen entries are zero, diverged ones `DIVERGED`."""
        worst = np.full((len(candidates), 1), DIVERGED)
        good = self._admissible(candidates, worst)
        frames = self.windows.target[stride - 1 :: stride]
        size = frames.shape[0] * self.body.count * 3
        result = np.full((len(candidates), self.windows.count, size), DIVERGED, dtype=np.float32)
        per_call = max(1, MOST_WORLDS // self.windows.count)
        seen = self.windows.seen[stride - 1 :: stride][:, None, :, :, None]
        for begin in range(0, len(good), per_call):
            part = good[begin : begin + per_call]
            error = self._errors([candidates[n] for n in part], stride)
            error = torch.where(torch.isfinite(error), error, DIVERGED).clamp(-DIVERGED, DIVERGED)
            error = torch.where(seen, error, 0.0).movedim(0, 2)
            result[part] = error.reshape(len(part), self.windows.count, size).numpy()
        return result

    def _errors(self, candidates: Sequence[Candidate], stride: int = 1) -> Tensor:
        """(K/stride, C, W, N, 3) prediction minus target."""
        w, count = self.windows, len(candidates)
        worlds = count * w.count
        substeps = max(self.substeps(c) for c in candidates)
        simulator = SpringMass(
            self.body if self.topology is None else self.topology.union,
            [c.physics for c in candidates for _ in range(w.count)],
            self.scene,
            period=self.period,
            substeps=substeps,
            extensions=[c.extensions for c in candidates for _ in range(w.count)],
            spring_mask=None if self.topology is None else self.topology.masks([c.physics for c in candidates], w.count),
            diverged_as_nan=True,
        )
        state = State(*(_tile(v, count) for v in (w.start.position, w.start.velocity, w.start.held)))
        start = simulator.start(state, Grip(*(_tile(v, count) for v in vars(w.start_grip).values())))
        grips = Grip(*(_tile(v.movedim(1, 0), count).movedim(0, 1) for v in vars(w.grips).values()))
        positions = simulator.rollout(start, grips)[stride - 1 :: stride]
        return positions.unflatten(1, (count, w.count)) - w.target[stride - 1 :: stride][:, None]

    def _admissible(self, candidates: Sequence[Candidate], result: Array) -> list[int]:
        """Indices within `most_substeps`; the rows of the others are charged."""
        needed = np.array([self.substeps(c) for c in candidates])
        beyond = needed > self.most_substeps
        result[beyond] = DIVERGED * (needed[beyond, None] / self.most_substeps)
        if self.topology is not None:
            loose = np.array([len(self.topology.loose(c.physics)) for c in candidates])
            result[loose > 0] = DIVERGED * (1.0 + loose[loose > 0, None])
            beyond |= loose > 0
        return [int(n) for n in np.flatnonzero(~beyond)]


def _tile(values: Tensor, count: int) -> Tensor:
    """(W, ...) repeated to (count * W, ...)."""
    return values.expand(count, *values.shape).reshape(count * values.shape[0], *values.shape[1:])


def _bend_bound(candidate: Candidate) -> tuple[float, float]:
    bounds = [find_effect(e.id).bend_bound(e.parameters) for e in candidate.extensions]
    return sum(b[0] for b in bounds), sum(b[1] for b in bounds)

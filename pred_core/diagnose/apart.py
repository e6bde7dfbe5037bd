"""How far apart two causes are over motions: both rolled out, with what is not known of either taken off.

T-optimality (Atkinson and Fedorov 1975): the distance of one cause from the nearest the other can come.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.diagnose.motions import Motion
from pred_core.diagnose.standing_start import SETTLE, Start
from pred_core.diagnose.weigh import CHAOS, START
from pred_core.identify.space import Candidate
from pred_core.springmass import SpringMass
from pred_core.twin import Twin
from pred_core.types import Array, Grip, State, stack_grips

DRAWS = 3  # perturbed starts
KNOWN = 0.05  # relative standard deviation of the base's parameters
UNSURE = ("stiffness", "ground_friction", "bending_stiffness")  # of them
THINNED = 2  # frames between those compared


@dataclass(frozen=True)
class Rival:
    """A cause with its values, and the same one standard deviation off in each of its strengths."""

    id: str
    family: str
    values: Mapping[str, float]
    candidate: Candidate
    shifted: tuple[tuple[Candidate, float], ...] = ()  # (point, standard deviations it is off)


@dataclass(frozen=True)
class Rolled:
    """One rival over all motions."""

    position: Tensor  # (M, K, N, 3) [m]
    slopes: Tensor  # (P, M, K, N, 3) [m] a standard deviation of each strength
    spread: Tensor  # (M, K, N) [m^2] of perturbed starts and base parameters, a coordinate


def roll(
    twin: Twin,
    rival: Rival,
    starts: Sequence[Start],
    motions: Sequence[Motion],
    sigma: float,
    generator: torch.Generator,
) -> Rolled:
    """The rival, itself with shifted strengths, and perturbed, each settled where the motion begins."""
    shaken = [_shaken(rival.candidate, generator) for _ in range(DRAWS)]
    points = [rival.candidate, *(c for c, _ in rival.shifted), *shaken]
    homes, count = len(starts), len(motions)
    settled = _settled(twin, points, starts)
    home = torch.tensor([p * homes + m.home for p in range(len(points)) for m in motions])
    state = State(settled.position[home], settled.velocity[home], settled.held[home],
                  {k: v[home] for k, v in settled.memory.items()})  # fmt: skip
    loose = (state.held < 0)[..., None].clone()
    loose[: (len(points) - DRAWS) * count] = False
    noise = [torch.randn(state.position.shape, generator=generator) * loose * START * sigma for _ in range(2)]
    velocity = state.velocity + 0.3 * noise[1] / twin.meta.period
    state = state.replace(position=state.position + noise[0], velocity=velocity)
    grips = [torch.as_tensor(np.stack([v for v in column], axis=1)).float().repeat(1, len(points), 1, 1)
             for column in ([m.position for m in motions], [m.rotation for m in motions])]  # fmt: skip
    closed = starts[0].grip.closed.expand(*grips[0].shape[:-1])
    simulator = _simulator(twin, points, count)
    raw = simulator.rollout(state, Grip(grips[0], grips[1], closed))[THINNED - 1 :: THINNED]
    x = raw.unflatten(1, (len(points), count)).permute(1, 2, 0, 3, 4)  # (points, M, K, N, 3)
    strengths = len(rival.shifted)
    scale = torch.tensor([s for _, s in rival.shifted]).reshape(-1, 1, 1, 1, 1)
    spread = (x[1 + strengths :] - x[0]).square().mean(dim=(0, -1))
    return Rolled(x[0], (x[1 : 1 + strengths] - x[0]) / scale, spread)


def _shaken(candidate: Candidate, generator: torch.Generator) -> Candidate:
    """With the base's parameters off by what is not known of them."""
    factor = torch.exp(KNOWN * torch.randn(len(UNSURE), generator=generator)).tolist()
    values = {name: getattr(candidate.physics, name) * f for name, f in zip(UNSURE, factor, strict=True)}
    return dataclasses.replace(candidate, physics=dataclasses.replace(candidate.physics, **values))


def _settled(twin: Twin, points: Sequence[Candidate], starts: Sequence[Start]) -> State:
    """Each point at each start, at rest after SETTLE with the grippers still."""
    many = len(points)
    state = State(
        torch.stack([s.state.position for s in starts]).repeat(many, 1, 1),
        torch.stack([s.state.velocity for s in starts]).repeat(many, 1, 1),
        torch.stack([s.state.held for s in starts]).repeat(many, 1),
    )
    one = stack_grips([s.grip for s in starts])
    grip = Grip(one.position.repeat(many, 1, 1), one.rotation.repeat(many, 1, 1), one.closed.repeat(many, 1))
    simulator = _simulator(twin, points, len(starts))
    begun = simulator.start(state, grip)
    memory = {**begun.memory, "time": torch.full_like(begun.memory["time"], max(s.session for s in starts))}
    frames = max(1, round(SETTLE / twin.meta.period))
    still = Grip(*(v[None].expand(frames, *v.shape) for v in (grip.position, grip.rotation, grip.closed)))
    return simulator.rollout_states(begun.replace(memory=memory), still)[1]


def _simulator(twin: Twin, points: Sequence[Candidate], each: int) -> SpringMass:
    extended = any(p.extensions for p in points)
    return SpringMass(
        twin.body,
        [p.physics for p in points for _ in range(each)],
        twin.scene,
        period=twin.meta.period,
        extensions=[p.extensions for p in points for _ in range(each)] if extended else (),
        diverged_as_nan=True,
    )


@dataclass(frozen=True)
class Separation:
    """How far apart two rivals are over M motions."""

    squared: Array  # (M,) distance in standard deviations, squared; 0 where either diverges
    remaining: Array  # (M, K, N, 3) [m] difference after the strengths have moved


def separation(a: Rolled, b: Rolled, sigma: float, free: Tensor) -> Separation:
    """sum ||x_a - x_b||^2 / (sigma^2 + s^2) over particles that are `free` (N,), at its least over the strengths of
    both, which a prior of unit variance holds to their intervals. `sigma` [m] noise of the tracks.
    """
    d = (a.position - b.position).double()
    usable = d.flatten(1).isfinite().all(dim=1)
    spread = 0.5 * (a.spread + b.spread).double()
    variance = sigma**2 + CHAOS * torch.where(spread.isfinite(), spread, torch.inf)  # what may diverge tells nothing
    weight = (free.double() / variance)[..., None]  # (M, K, N, 1)
    slopes = torch.cat((-a.slopes, b.slopes)).double()  # moving either: d + slopes . delta
    distances, remaining = np.zeros(len(d)), np.zeros(d.shape)
    for m in range(len(d)):
        if not usable[m]:
            continue
        j = slopes[:, m].flatten(1)
        w = weight[m].expand(d[m].shape).flatten()
        left = d[m].flatten()
        if len(j) and bool(j.isfinite().all()):
            h = (j * w) @ j.T + torch.eye(len(j), dtype=torch.float64)
            delta = -torch.linalg.solve(h, (j * w) @ left)
            left = left + delta @ j
            distances[m] = float((w * left.square()).sum() + delta.square().sum())
        else:
            distances[m] = float((w * left.square()).sum())
        remaining[m] = left.reshape(d[m].shape).numpy()
    return Separation(distances, remaining)

"""What the network adds, step by step, and what each candidate cause would have added in the same states.

Both are measured by what they do to the positions a little later: a push that the springs undo at once, and there are
many in the output of a network on a stiff object, moves nothing and counts for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pred_core.diagnose.guard_probes import Probe, Probes
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.sample import Sample
from pred_core.dynamics import FARTHEST, Dynamics
from pred_core.effects import find_effect
from pred_core.errors import InputError
from pred_core.identify.space import Candidate
from pred_core.pred import BASE, Advance, PReD
from pred_core.residual import ResidualNetwork
from pred_core.springmass import SpringMass
from pred_core.springmass.arrays import chains
from pred_core.twin import Twin
from pred_core.types import Array, Grip, State

MOST_STATES = 3000  # (world, step) pairs that are compared
LATER = 0.1  # [s] after which the positions are compared


@dataclass(frozen=True)
class Path:
    """Open-loop rollouts of W episodes with the network: states before each of K steps, and what it then added."""

    states: list[State]  # K states (W, N, 3) of the backbone, with its memory
    added: Tensor  # (K, W, N, 3) [m/s] the network's velocity
    counts: Tensor  # (K, W, N) bool: free, measured in the episode, finite

    @property
    def speed(self) -> float:
        """[m/s] root mean square over particles of what the network adds in a step."""
        return float(self.added[self.counts].square().sum(dim=-1).mean().sqrt())


@dataclass(frozen=True)
class Moments:
    """Sums of products over all that counts, for least squares: column p < P is a probe's, the last the network's.

    A column is where free particles are `LATER` if one period is with the probe, or ends with the network's velocity,
    minus where they are without; no network acts after that.
    """

    products: Array  # (G, P + 1, P + 1) [m^2]
    groups: tuple[int, ...]  # (G,) recording of each
    values: int  # free particles' places that were compared


def backbone(twin: Twin, worlds: Sequence[Candidate], substeps: int | None) -> SpringMass:
    """The twin's simulator with these worlds, or one for any; one that diverges becomes NaN, the others go on."""
    return SpringMass(
        twin.body, [c.physics for c in worlds], twin.scene, period=twin.meta.period, substeps=substeps,
        extensions=[c.extensions for c in worlds], diverged_as_nan=True,
    )  # fmt: skip


def with_network(twin: Twin, network: ResidualNetwork) -> PReD:
    """The twin's simulator corrected by a network."""
    base = backbone(twin, [Candidate(twin.physics, twin.extensions)], twin.meta.substeps)
    return PReD(base, network.eval(), twin.body)


@torch.no_grad()
def roll(model: PReD, sample: Sample) -> Path:
    """Every first window of the sample, open loop with the network.

    Raises: InputError if the network moves nothing at all.
    """
    w = sample.windows
    state = model.start(w.start, w.start_grip)
    memory = {**state.memory, BASE + "time": sample.time.clone()}
    state = state.replace(memory=memory)
    states, added, counts = [], [], []
    for k in range(len(w.target)):
        before = model.base_state(state)
        step: Advance = model.advance(state, w.grips.at(k))
        near = (before.position.abs() < FARTHEST).all(dim=(-1, -2)) & torch.isfinite(step.residual).all(dim=(-1, -2))
        states.append(before)
        added.append(step.residual)
        counts.append(w.seen[k] & (step.predicted.held < 0) & near[:, None])
        state = step.state
    path = Path(states, torch.stack(added), torch.stack(counts))
    if not bool((path.added[path.counts] != 0.0).any()):
        raise InputError(
            "the network adds nothing, so there is nothing that it could hide",
            next_step="Train it longer, or on more data",
        )
    return path


@torch.no_grad()
def moments(path: Path, roller: Roller, probes: Probes) -> Moments:
    """Every probe beside the network, over the states of `path`.

    All episodes times all probes are the worlds of one simulator, so that one kernel serves the whole library.
    Each step begins in the path's state; a law's own memory is carried from the step before.
    """
    sample, twin = roller.sample, roller.twin
    everything: list[Probe | None] = [None, *probes.rows]
    candidates = [probes.candidate(p, twin.physics) for p in everything]
    substeps = max(roller.substeps(candidates), twin.meta.substeps or 1)
    number, width = len(everything), sample.windows.count
    simulator = backbone(twin, [c for c in candidates for _ in range(width)], substeps)
    groups = tuple(sorted(set(sample.groups.tolist())))
    group = torch.tensor([groups.index(int(sample.groups[e])) for e in sample.episode.tolist()])
    products = torch.zeros(len(groups), number, number, dtype=torch.float64)
    onward = backbone(twin, candidates[:1], substeps)
    ahead = min(max(1, round(LATER / twin.meta.period)), len(path.states) - 1)
    every = max(1, math.ceil(len(path.states) * width / MOST_STATES))
    shared, values = _shared_memory(twin), 0
    memory: Tensor | None = None
    for k, state in enumerate(path.states[:-ahead]):
        started, grips = _started(simulator, state, sample.windows.grips.at(k), number, memory)
        after = simulator.step(started, grips)
        memory = after.memory["effects"].unflatten(0, (number, width)).clone()
        memory[:, :, :shared] = memory[:1, :, :shared]
        if k % every == 0:
            begin = _with_network(after, path.added[k], twin.meta.period)
            coming = sample.windows.grips.span(k + 1, k + 1 + ahead)
            coming = Grip(*(_tiled(v, number + 1, 1) for v in (coming.position, coming.rotation, coming.closed)))
            place = onward.rollout(begin, coming)[-1].unflatten(0, (number + 1, width))
            columns = place[1:] - place[:1]  # (P + 1, W, N, 3), the network last
            finite = torch.isfinite(columns).all(dim=0).all(dim=(-1, -2))
            mask = path.counts[k] & path.counts[k + ahead] & finite[:, None]
            rows = torch.where(mask[None, ..., None], columns, 0.0).double().movedim(1, 0).flatten(2)
            products.index_add_(0, group, rows @ rows.mT)
            values += int(mask.sum())
    return Moments(np.asarray(products.numpy()), groups, values)


def _with_network(after: State, added: Tensor, period: float) -> State:
    """The worlds of all probes, and after them those without a probe and with the network's velocity `added`."""
    plain = slice(0, len(added))
    return State(
        torch.cat((after.position, after.position[plain] + added * period)),
        torch.cat((after.velocity, after.velocity[plain] + added)),
        torch.cat((after.held, after.held[plain])),
        {k: torch.cat((v, v[plain])) for k, v in after.memory.items()},
    )


def _started(
    simulator: Dynamics, state: State, grip: Grip, number: int, memory: Tensor | None
) -> tuple[State, Grip]:
    """`state` (W, ...) in `number` copies, probe by probe, and the grip at the end of the step."""

    grips = Grip(*(_tiled(v, number) for v in (grip.position, grip.rotation, grip.closed)))
    kept = {k: _tiled(v, number) for k, v in state.memory.items() if k != "effects"}
    plain = State(_tiled(state.position, number), _tiled(state.velocity, number), _tiled(state.held, number))
    if memory is None:
        before = Grip(*(kept[f"grip_{k}"] for k in ("position", "rotation", "closed")))
        effects = simulator.start(plain, before).memory["effects"]
    else:
        effects = memory.flatten(0, 1)
    return plain.replace(memory={**kept, "effects": effects}), grips


def _tiled(values: Tensor, number: int, dim: int = 0) -> Tensor:
    """`number` copies after each other along `dim`."""
    return values.repeat(*[1] * dim, number, *[1] * (values.dim() - dim - 1))


def _shared_memory(twin: Twin) -> int:
    """Leading values of `effects` memory that belong to the twin as it is: frames of lines, curvatures, its laws'.

    They are alike in all worlds: a probe acts for one period at a time.
    """
    laws = [find_effect(e.id) for e in twin.extensions]
    per_line, per_bend = 4 + sum(e.line_values for e in laws), 2 + sum(e.bend_memory for e in laws)
    return per_line * len(chains(twin.body)) + per_bend * len(twin.body.bends)

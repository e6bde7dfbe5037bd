"""Where a proposed motion may begin: measured poses of the grippers at which the object is nearly at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pred_core.bag.clock import on_even_clock
from pred_core.train.recordings import Recording, align, start_frames
from pred_core.twin import Twin
from pred_core.types import Array, Episode, Grip, State

SETTLE = 1.5  # [s] the object rests before the motion begins
TOUCHING = 0.004  # [m] above the table a particle's surface counts as touching
LYING = 0.2  # share of particles that touch from which an episode is one on the table
MIDDLE = 0.5  # how much a place in the middle of the workspace is worth, beside stillness


@dataclass(frozen=True)
class Start:
    """A measured state to begin at."""

    episode: str
    frame: int
    state: State  # no batch axis, at rest
    grip: Grip  # (G, ...)
    axis: Array  # (3,) unit, the object's direction where it is held
    over: Array  # (3,) horizontal unit, from the grippers to the object's middle
    touches: bool  # the object lies on a table
    like: tuple[str, ...]  # episodes of the same kind: in the air, or on the table
    session: float  # [s] when the session was over


def starts_of(twin: Twin, episodes: Sequence[Episode]) -> list[Start]:
    """The calmest complete frame near the middle of the workspace: one in the air and one on the table, if there are.

    Only episodes that hold what the first one holds. Raises: DatasetError if the tracks are not of this twin.
    """
    session = (max(int(e.stamps[-1]) for e in episodes) - min(int(e.stamps[0]) for e in episodes)) * 1e-9
    rows = [(e, align(on_even_clock(e), twin.body, twin.meta.period)) for e in episodes]
    held = rows[0][1].held[0]
    rows = [(e, r) for e, r in rows if torch.equal(r.held[0], held)]
    found = []
    for lies in (False, True):
        kind = [(e, r) for e, r in rows if (_lying(twin, r) >= LYING) == lies]
        best = min((_calmest(e, r, kind) for e, r in kind), default=None, key=lambda row: row[0])
        if best is not None and np.isfinite(best[0]):
            found.append(_start(twin, *best[1:], lies, tuple(e.name for e, _ in kind), session))
    return found


def _lying(twin: Twin, r: Recording) -> float:
    """Share of particles on the table."""
    ground = twin.scene.ground
    if ground is None:
        return 0.0
    height = r.position[..., 2] - ground - twin.body.radius
    return float((height[torch.isfinite(height)] < TOUCHING).double().mean())


def _calmest(
    e: Episode, r: Recording, kind: Sequence[tuple[Episode, Recording]]
) -> tuple[float, Episode, Recording, int]:
    """(score, episode, recording, frame): speed of the object over its usual one, and distance to the middle."""
    places = torch.cat([o.grips.position.reshape(-1, 3) for _, o in kind])
    middle = (places.amax(dim=0) + places.amin(dim=0)) / 2
    half = float((places.amax(dim=0) - places.amin(dim=0)).norm()) / 2
    moved = (r.position[1:] - r.position[:-1]).norm(dim=-1).mean(dim=-1)
    speed = torch.cat((torch.tensor([torch.inf]), moved))
    usual = float(speed[torch.isfinite(speed)].median()) if bool(torch.isfinite(speed).any()) else 1.0
    away = (r.grips.position - middle).norm(dim=-1).amax(dim=-1) / max(half, 1e-6)
    score = speed / max(usual, 1e-9) + MIDDLE * away
    score = torch.where(start_frames(r) & torch.isfinite(score), score, torch.inf)
    frame = int(score.argmin())
    return float(score[frame]), e, r, frame


def _start(
    twin: Twin, e: Episode, r: Recording, frame: int, lies: bool, like: tuple[str, ...], session: float
) -> Start:
    position, held = r.position[frame], r.held[frame]
    grip = r.grips.at(frame)
    taken = np.flatnonzero((held >= 0).numpy())
    x = position.double().numpy()
    axis = np.array([0.0, 0.0, 1.0])
    if len(taken):
        near = [int(b if a in taken else a) for a, b in twin.body.springs if (a in taken) != (b in taken)]
        if near:
            axis = x[near].mean(axis=0) - x[taken].mean(axis=0)
            axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
    over = x.mean(axis=0) - grip.position.double().numpy().mean(axis=0)
    over[2] = 0.0
    far = float(np.linalg.norm(over))
    over = over / far if far > 1e-6 else np.array([1.0, 0.0, 0.0])
    state = State(position.float(), torch.zeros_like(position).float(), held)
    return Start(e.name, frame, state, grip, axis, over, lies, like, session)

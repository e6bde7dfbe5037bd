"""The protocol: start from frames 0 and 1, then open loop to the last frame, nothing corrected on the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from pred_core.dynamics import FARTHEST, Dynamics, on_clock
from pred_core.errors import DatasetError, DivergenceError, TwinError
from pred_core.train.recordings import PERIOD_TOLERANCE
from pred_core.types import Array, Episode, Grip, State, stack_grips, stack_states

START_FRAME = 1  # the state is measured at this frame, its velocity from this frame and the one before
FIRST_PREDICTED = START_FRAME + 1


@runtime_checkable
class UsesOneMoreFrame(Protocol):
    """A Dynamics that also needs the frame after the start (`LastResidual`)."""

    def start_after(
        self, before: State, grip_before: Grip, now: State, grip: Grip, seconds: Tensor | None = None
    ) -> tuple[State, Tensor]:
        """The state started at `now`, and the base's own prediction of it. `seconds` [s] of the session at `before`."""


def predict(dynamics: Dynamics, episodes: Sequence[Episode], begin: int | None = None) -> list[Array]:
    """Open-loop predictions of frames 2 .. T-1 of every episode, each (T-2, P, 3) [m] world.

    `begin` [ns]: when their session began, for what drifts over it; None: every episode is at its begin.

    Episodes of equal length run as one batch. From the step at which an episode diverges its prediction is
    NaN (see `diverged_at`); the other episodes of the batch are unaffected.
    Raises: DatasetError for unequal particle counts or episodes shorter than three frames; TwinError if the
    model's period is not the frame period; InputError if a particle is not measured at the start.
    """
    check_episodes(episodes)
    for episode in episodes:
        if abs(episode.period / dynamics.period - 1.0) > PERIOD_TOLERANCE:
            raise TwinError(
                f"{episode.name}: the model steps {dynamics.period:.5g} s but frames are {episode.period:.5g} s apart",
                next_step="Evaluate at the rate the twin was identified at",
            )
    groups: dict[tuple[int, int], list[int]] = {}
    for i, episode in enumerate(episodes):
        groups.setdefault((len(episode.stamps), episode.grips.position.shape[1]), []).append(i)
    predictions: dict[int, Array] = {}
    for indices in groups.values():
        for i, position in zip(indices, _predict_batch(dynamics, [episodes[i] for i in indices], begin), strict=True):
            predictions[i] = position
    return [predictions[i] for i in range(len(episodes))]


def check_episodes(episodes: Sequence[Episode]) -> None:
    """Raise DatasetError unless the episodes can be scored side by side."""
    if not episodes:
        raise DatasetError("no episodes to evaluate")
    ids = episodes[0].tracks.id
    for episode in episodes:
        if len(episode.tracks.id) != len(ids):
            raise DatasetError(
                f"{episode.name}: particle count differs from {episodes[0].name}",
                got=len(episode.tracks.id), allowed=len(ids),
                next_step="Evaluate objects with different particles as separate data sets",
            )
        if not np.array_equal(episode.tracks.id, ids):
            raise DatasetError(f"{episode.name}: particle ids differ from {episodes[0].name}")
        if len(episode.stamps) <= FIRST_PREDICTED:
            raise DatasetError(f"{episode.name}: too short", got=f"{len(episode.stamps)} frames",
                               allowed=f"{FIRST_PREDICTED + 1} or more")


def diverged_at(prediction: Array) -> int | None:
    """The step (1 = first predicted frame) at which a prediction of `predict` stops being usable, or None."""
    bad = ~np.isfinite(prediction).all(axis=(1, 2))
    return int(bad.argmax()) + 1 if bad.any() else None


def _predict_batch(dynamics: Dynamics, episodes: Sequence[Episode], begin: int | None) -> list[Array]:
    """Equal lengths, equal numbers of grippers."""
    seconds = None if begin is None else _seconds(episodes, begin)
    grips = stack_grips([e.grips for e in episodes], dim=1)
    frames = grips.position.shape[0]
    with torch.no_grad():
        first: Tensor | None = None
        if isinstance(dynamics, UsesOneMoreFrame):
            before, now = (stack_states([e.state_at(START_FRAME + k) for e in episodes]) for k in (0, 1))
            state, predicted = dynamics.start_after(
                before, grips.at(START_FRAME), now, grips.at(FIRST_PREDICTED), seconds
            )
            first, first_step = predicted[None], FIRST_PREDICTED + 1
        else:
            state = stack_states([e.state_at(START_FRAME) for e in episodes])
            state, first_step = dynamics.start(state, grips.at(START_FRAME)), FIRST_PREDICTED
            state = state if seconds is None else on_clock(state, seconds)
        try:
            positions = dynamics.rollout(state, grips.span(first_step, frames))
        except DivergenceError:
            positions = _one_by_one(dynamics, state, grips.span(first_step, frames))
    if first is not None:
        positions = torch.cat((first, positions))
    whole = positions.double().numpy(force=True)
    return [_cut(whole[:, i]) for i in range(len(episodes))]


def _seconds(episodes: Sequence[Episode], begin: int) -> Tensor:
    """(B,) [s] of the session at the frame that predictions start from."""
    return torch.tensor([(int(e.stamps[START_FRAME]) - begin) * 1e-9 for e in episodes], dtype=torch.float32)


def _one_by_one(dynamics: Dynamics, state: State, grips: Grip) -> Tensor:
    """Positions (T, B, N, 3), each world on its own; NaN from the step at which a world diverges."""
    worlds = []
    for w in range(state.position.shape[0]):
        memory = {key: value[w] for key, value in state.memory.items()}
        one = State(state.position[w], state.velocity[w], state.held[w], memory)
        grip = Grip(grips.position[:, w], grips.rotation[:, w], grips.closed[:, w])
        try:
            worlds.append(dynamics.rollout(one, grip))
        except DivergenceError:
            worlds.append(_until_divergence(dynamics, one, grip))
    return torch.stack(worlds, dim=1)


def _until_divergence(dynamics: Dynamics, state: State, grips: Grip) -> Tensor:
    """Positions (T, N, 3) of one world, NaN from the step at which `step` refuses to go on."""
    positions = torch.full((grips.position.shape[0], *state.position.shape), torch.nan)
    for t in range(len(positions)):
        try:
            state = dynamics.step(state, grips.at(t))
        except DivergenceError:
            break
        positions[t] = state.position
    return positions


def _cut(position: Array) -> Array:
    """The prediction with NaN from the first frame that is not finite or outside the scene."""
    with np.errstate(invalid="ignore"):
        bad = ~(np.abs(position) < FARTHEST).all(axis=(1, 2))
    if bad.any():
        position = position.copy()
        position[int(bad.argmax()) :] = np.nan
    return np.asarray(position)

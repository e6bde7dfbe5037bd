"""Errors in millimetres: whole episodes replayed open loop with a twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pred_core.diagnose.roll import FARTHEST, Roller
from pred_core.diagnose.sample import make_sample
from pred_core.evaluate.bootstrap import bootstrap_interval
from pred_core.identify.space import Candidate
from pred_core.twin import Twin
from pred_core.types import Array, Episode

WHOLE = 1e6  # [s]


@dataclass(frozen=True)
class EpisodeErrors:
    """Mean distance [mm] of free particles from their measurement, one value an episode."""

    names: tuple[str, ...]
    values: Array  # (E,)
    diverged: tuple[str, ...] = ()  # episodes in which the simulation was not finite, or FARTHEST away

    @property
    def mean(self) -> float:
        """Over episodes."""
        return float(self.values.mean())


def episode_errors(twin: Twin, episodes: Sequence[Episode], begin: int | None = None) -> EpisodeErrors:
    """Errors of these episodes. `begin` [ns]: when their session began, for what drifts over it.

    Starts are estimated over several frames, as in the diagnosis; `pred evaluate` takes them raw from two.
    """
    sample = make_sample(episodes, twin, WHOLE, begin)
    roller = Roller(twin, sample)
    error = roller.errors([Candidate(twin.physics, twin.extensions)])[0]
    far = (error.abs() >= FARTHEST).flatten(1).any(dim=1).double().numpy()
    error = error.norm(dim=-1).clamp_max(FARTHEST)
    seen = sample.windows.seen.movedim(0, 1)
    mean = error.sum((1, 2)).double() / seen.sum((1, 2)).clamp_min(1)
    bad = sample.per_episode(far) > 0.0
    diverged = tuple(n for n, b in zip(sample.names, bad.tolist(), strict=True) if b)
    return EpisodeErrors(sample.names, 1e3 * sample.per_episode(mean.numpy()), diverged)


@dataclass(frozen=True)
class Gain:
    """Base minus extended, over episodes [mm]."""

    mean: float
    low: float
    high: float
    improved: int
    episodes: int


def gain_of(base: EpisodeErrors, extended: EpisodeErrors, seed: int) -> Gain:
    """Mean gain with a 95 % interval over episodes."""
    difference = base.values - extended.values
    mean = float(difference.mean())
    low, high = (mean, mean) if len(difference) < 2 else bootstrap_interval(difference, np.random.default_rng(seed))
    return Gain(mean, low, high, int((difference > 0).sum()), len(difference))


def predicted(twin: Twin, episode: Episode, begin: int | None = None) -> tuple[Array, Array]:
    """(predicted (K, N, 3), measured (K, N, 3) with NaN where not seen) [m] of one whole episode, for pictures.

    `begin` as in `episode_errors`, whose error of the episode this is.
    """
    sample = make_sample([episode], twin, WHOLE, begin)
    roller = Roller(twin, sample)
    positions = roller.positions(Candidate(twin.physics, twin.extensions))[0]
    target = torch.where(sample.windows.seen[:, 0, :, None], sample.windows.target[:, 0], torch.nan)
    return positions.double().numpy(), target.double().numpy()

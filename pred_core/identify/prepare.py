"""From episodes to what a search needs: the body, aligned recordings, the knobs and their bounds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pred_core.bag.dataset import Dataset
from pred_core.errors import ConfigError
from pred_core.identify.body import Layout, lay_out
from pred_core.identify.config import IdentifyConfig
from pred_core.identify.space import DISCRETE, SearchSpace, search_space
from pred_core.identify.stages import Stages, Tell
from pred_core.identify.starts import track_noise
from pred_core.identify.topology import Topology
from pred_core.train.recordings import Recording, align
from pred_core.types import Episode, Physics


@dataclass(frozen=True)
class Prepared:
    """An identification before its search."""

    stages: Stages
    space: SearchSpace
    recordings: list[Recording]
    noise: float  # [m] of the tracks
    notes: tuple[str, ...]  # what the user should know


def prepare(dataset: Dataset, episodes: Sequence[Episode], config: IdentifyConfig, tell: Tell) -> Prepared:
    """Lay out the body, align the episodes, choose the knobs.

    Raises: DatasetError or ConfigError on unusable data or settings.
    """
    if not config.stages:
        raise ConfigError("stages", got="none", allowed="at least one window length [s]")
    layout = lay_out(dataset, episodes, config)
    period = float(np.median([e.period for e in episodes]))
    recordings = [align(e, layout.body, period) for e in episodes]
    _check_lengths(recordings, period, config)
    noise = dataset.sigma if dataset.sigma is not None else track_noise(recordings)
    layout = lay_out(dataset, episodes, config, noise)
    space, notes = _space(layout, config)
    if not layout.mass_known:
        notes.append(f"mass is nominal ({config.mass:g} kg): motion alone does not show it")
    stages = Stages(layout, _topology(layout, config), period, noise if config.estimate_starts else None, config, tell)
    return Prepared(stages, space, recordings, noise, tuple(notes))


def _check_lengths(recordings: Sequence[Recording], period: float, config: IdentifyConfig) -> None:
    longest = (max(len(r.position) for r in recordings) - 2) * period
    if config.window > longest + 0.5 * period:
        raise ConfigError(
            "window",
            got=f"{config.window:g} s",
            allowed=f"at most {longest:.4g} s, what the longest recording holds after its first two frames",
            next_step="Give a shorter --window",
        )


def _topology(layout: Layout, config: IdentifyConfig) -> Topology | None:
    if not set(DISCRETE) & set(config.parameters):
        return None
    return Topology(layout.body, layout.longest, 8 if layout.body.kind == "line" else 24)


def _space(layout: Layout, config: IdentifyConfig) -> tuple[SearchSpace, list[str]]:
    """Knobs with the connection rule bounded by the object's own spacing, and notes on what cannot be searched."""
    line = layout.body.kind == "line"
    names, notes = list(config.parameters), []
    if "ground_friction" in names and layout.scene.ground is None:
        names.remove("ground_friction")
        notes.append("ground_friction is not searched: no ground is given (--ground)")
    if "bending_stiffness" in names and not len(layout.body.bends):
        names.remove("bending_stiffness")
        notes.append("bending_stiffness is not searched: the object has no straight runs of springs")
    physics = Physics(
        connection_threshold=layout.shortest,
        max_springs=2 if line else 8,
        bending_stiffness=1e-3 if "bending_stiffness" in names else 0.0,
    )
    space = search_space(physics, names, config.effects)
    if not space.knobs:
        raise ConfigError("nothing to search", got="; ".join(notes) or "no --parameters and no --effects")
    knobs = []
    for knob in space.knobs:
        if knob.name == "connection_threshold":
            scale = float(np.log(layout.longest / layout.shortest)) / 6.0
            knob = dataclasses.replace(knob, low=layout.shortest, high=layout.longest, scale=scale)
        if knob.name == "max_springs":
            low, high = (2, 8) if line else (4, 24)
            knob = dataclasses.replace(knob, low=low, high=high, scale=2.0)
        knobs.append(knob)
    return SearchSpace(tuple(knobs), space.physics, space.extensions), notes

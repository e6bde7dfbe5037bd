"""Where an offline plan begins and ends: a frame of a data set, a twin at rest, or a cloud in a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from pred_core.bag.dataset import load_dataset
from pred_core.errors import DatasetError, InputError, TwinError
from pred_core.plan.latency import Observation
from pred_core.twin import Twin
from pred_core.types import Array, Episode, State

CLOUD_SUFFIXES = (".npy", ".csv", ".txt", ".xyz")


def rest_observation(twin: Twin, held: Mapping[int, int] | None) -> Observation:
    """The twin at its rest shape, without motion; each gripper stands in the middle of what it holds.

    held: particle id -> gripper; None: what the twin knows. Raises: TwinError if nothing is held.
    """
    pairs = dict(twin.meta.held) if held is None else dict(held)
    if not pairs:
        raise TwinError("the twin does not say what is held", next_step="Give --held 'particle:gripper', e.g. '0:0'")
    unknown = sorted(set(pairs) - set(twin.body.id.tolist()))
    if unknown:
        raise TwinError("particles that the twin does not have", got=unknown[:5])
    grippers = max(pairs.values()) + 1
    missing = sorted(set(range(grippers)) - set(pairs.values()))
    if missing:
        raise TwinError("grippers that hold nothing", got=missing, allowed=f"0 to {grippers - 1}, each with a particle")
    column = {int(i): k for k, i in enumerate(twin.body.id)}
    index = np.full(twin.body.count, -1, np.int32)
    for particle, gripper in pairs.items():
        index[column[particle]] = gripper
    rest = twin.body.rest_position
    position = np.stack([rest[index == g].mean(axis=0) for g in range(grippers)])
    rotation = np.zeros((grippers, 4))
    rotation[:, 0] = 1.0
    x = torch.as_tensor(rest, dtype=torch.float32)
    return Observation(0, State(x, torch.zeros_like(x), torch.as_tensor(index)), position, rotation)


def episode_of(dataset: Path, name: str | None) -> Episode:
    """An episode of a data set; None: the first. Raises: DatasetError naming those that exist."""
    loaded = load_dataset(dataset)
    names = [Path(e.bag).stem for e in loaded.entries]
    if name is not None and name not in names:
        raise DatasetError(f"{dataset}: no episode '{name}'", allowed=", ".join(names[:12]))
    return loaded.read(loaded.entries[0 if name is None else names.index(name)])


def episode_observation(twin: Twin, episode: Episode, frame: int) -> Observation:
    """What was measured at a frame (>= 1; negative: from the end). Raises: InputError, TwinError for another object."""
    if len(episode.tracks.id) != twin.body.count or not np.array_equal(episode.tracks.id, twin.body.id):
        raise TwinError(f"{episode.name}: its particles are not the twin's", got=f"{len(episode.tracks.id)} ids",
                        allowed=f"{twin.body.count} ids")  # fmt: skip
    at = frame if frame >= 0 else len(episode.stamps) + frame
    state = episode.state_at(at)
    if twin.meta.held:
        held = np.full(twin.body.count, -1, np.int32)
        for particle, gripper in twin.meta.held:
            held[twin.body.id == particle] = gripper
        state = state.replace(held=torch.as_tensor(held))
    grip = episode.grips.at(at)
    return Observation(int(episode.stamps[at]), state, grip.position.double().numpy(), grip.rotation.double().numpy())


def episode_cloud(episode: Episode, frame: int) -> Array:
    """The particles measured at a frame (negative: from the end), (Q, 3) [m]."""
    count = len(episode.stamps)
    if not -count <= frame < count:
        raise InputError(f"{episode.name}: no frame {frame}", allowed=f"{-count} to {count - 1}")
    points = episode.position[frame]
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def read_cloud(path: Path) -> Array:
    """Points (Q, 3) [m] of a .npy array or of a text file with three columns. Raises: InputError."""
    if path.suffix not in CLOUD_SUFFIXES:
        raise InputError(f"{path}: unknown kind of cloud", got=path.suffix or "no suffix",
                         allowed=f"{', '.join(CLOUD_SUFFIXES)} or a data set")  # fmt: skip
    try:
        if path.suffix == ".npy":
            points = np.load(path, allow_pickle=False)
        else:
            points = np.loadtxt(path, delimiter="," if path.suffix == ".csv" else None, ndmin=2)
        return np.asarray(points, float)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as points", got=error, allowed="three numbers a point") from error

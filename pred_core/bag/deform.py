"""The measured cables of DEFORM (arXiv 2406.05931): its npz, or the pickles of its repository, as a data set."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.clouds import check_extent
from pred_core.bag.dataset import FILE, Dataset, EpisodeEntry, file_sha256, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.bag.pickles import read_pickled_numbers
from pred_core.errors import BagError, DatasetError
from pred_core.types import Episode, Grip, ObjectInfo, Tracks

RATE = 100.0  # [Hz] motion capture
SIGMA = 0.00006  # [m] marker noise, 0.05 to 0.07 mm
SPLITS = {"train": "train", "eval": "test"}  # folder or npz name -> split
SOURCE_FILE = "source.json"  # which file the bags were made from; an interrupted conversion goes on
FIRST_STAMP = 1_000_000_000  # [ns] the source has no clock; 0 means "no time" in ROS
SAME_RECORDING = 0.015  # [m] see `group_recordings`

Progress = Callable[[int, int, str], None]  # done, total, name


@dataclass(frozen=True)
class DeformSource:
    """Episodes of one cable as published."""

    name: str
    position: tuple[NDArray[np.float64], ...]  # each (T, V, 3) [m] world
    split: tuple[str, ...]
    recording: tuple[int, ...]
    origin: tuple[str, ...]  # what an error calls each episode
    digest: str  # identifies the source

    @property
    def held(self) -> dict[int, int]:
        """Each clamped vertex (the two at each end) is a gripper of its own."""
        count = self.position[0].shape[1]
        return {0: 0, 1: 1, count - 2: 2, count - 1: 3}


def read_deform(path: Path | str) -> DeformSource:
    """Read the npz file, or a folder with train/*.pkl and eval/*.pkl. Raises: DatasetError."""
    path = Path(path)
    source = _read_folder(path) if path.is_dir() else _read_npz(path)
    counts = {p.shape[1] for p in source.position}
    if len(counts) != 1 or min(counts) < 5:
        raise DatasetError(f"{path}: vertices per episode", got=sorted(counts), allowed="one number, at least 5")
    for name, position in zip(source.origin, source.position, strict=True):
        if not np.isfinite(position).all():
            raise DatasetError(f"{path}: {name} has coordinates that are not finite", next_step="Leave it out")
        try:
            check_extent(position.reshape(-1, 3), name)
        except BagError as error:
            raise DatasetError(f"{path}: {error}") from error
    return source


def convert_deform(source: DeformSource, root: Path, progress: Progress) -> Dataset:
    """Write one bag an episode and `dataset.yaml`. Finished bags of the same source are kept.

    Raises: DatasetError if `root` holds something else.
    """
    claim_folder(root, {"source": source.name, "sha256": source.digest, "format": 1})
    entries = []
    total = len(source.position)
    for i in range(total):
        bag = f"ep{i:03d}.mcap"
        entries.append(EpisodeEntry(bag, source.split[i], source.recording[i]))
        if not (root / bag).exists():
            write_episode(root / bag, deform_episode(source, i))
        progress(i + 1, total, bag)
    return write_dataset(
        root, object=ObjectInfo(source.name, "line"), rate=RATE, entries=entries, sigma=SIGMA, held=source.held
    )


def deform_episode(source: DeformSource, index: int) -> Episode:
    """One published episode: the clamped vertices' measured positions are the gripper positions.

    Gripper order is `source.held`: the two clamped vertices of the first end, then of the last.
    """
    position = source.position[index]
    frames, count, _ = position.shape
    held = np.full(count, -1, np.int32)
    for particle, gripper in source.held.items():
        held[particle] = gripper
    stamps = FIRST_STAMP + np.arange(frames, dtype=np.int64) * round(1e9 / RATE)
    seen = np.ones((frames, count), bool)
    tracks = Tracks(stamps, position, np.arange(count, dtype=np.uint32), seen, seen.astype(np.float32))
    grips = Grip(
        position=torch.as_tensor(position[:, list(source.held)], dtype=torch.float32),
        rotation=torch.as_tensor(clamp_rotation(position), dtype=torch.float32),
        closed=torch.ones(frames, len(source.held), dtype=torch.bool),
    )
    return Episode(
        name=f"ep{index:03d}",
        object=ObjectInfo(source.name, "line"),
        stamps=stamps,
        tracks=tracks,
        grips=grips,
        held=held,
        split=source.split[index],
        recording=source.recording[index],
    )


def clamp_rotation(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gripper rotations (T, 4, 4) wxyz from positions (T, V, 3): the source measured only the clamped markers.

    Each clamp is taken to be turned by the smallest rotation that takes the vertical to its clamped edge: the first
    edge enters pointing down (-z), the last leaves pointing up (+z). Rotation about the edge itself is unknown.
    """
    rotations = []
    for a, b, vertical in ((0, 1, -1.0), (-2, -1, 1.0)):
        edge = position[:, b] - position[:, a]
        edge = edge / np.linalg.norm(edge, axis=1, keepdims=True)
        axis = np.cross(np.array([0.0, 0.0, vertical]), edge)
        rotation = np.concatenate((1.0 + vertical * edge[:, 2:], axis), axis=1)
        rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
        rotations += [rotation, rotation]
    return np.stack(rotations, axis=1)


def group_recordings(position: tuple[NDArray[np.float64], ...]) -> tuple[int, ...]:
    """Recording index of each episode, found from the motion, where the source (the pickles) does not name it.

    Episodes are adjacent windows of longer recordings: the next one begins where this one, moved on by one
    frame, ends. On both published cables adjacent windows meet within 6.5 mm and no others within 42 mm.
    """
    ahead = np.stack([2.0 * p[-1] - p[-2] for p in position])
    first = np.stack([p[0] for p in position])
    group = list(range(len(position)))

    def root(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for i, end in enumerate(ahead):
        distance = np.linalg.norm(first - end, axis=-1).max(axis=-1)
        distance[i] = np.inf
        if len(distance) > 1 and distance.min() < SAME_RECORDING:
            a, b = sorted((root(i), root(int(distance.argmin()))))
            group[b] = a
    numbers: dict[int, int] = {}
    return tuple(numbers.setdefault(root(i), len(numbers)) for i in range(len(position)))


def claim_folder(root: Path, source: dict[str, object]) -> None:
    """Make `root` the folder of this source, or find that it already is.

    Raises: DatasetError if it holds a data set of another source or other files.
    """
    path = root / SOURCE_FILE
    try:
        root.mkdir(parents=True, exist_ok=True)
        for partial in root.glob(".*.part"):
            partial.unlink()
        if [p.name for p in root.iterdir()] == [SOURCE_FILE]:
            path.unlink()  # nothing came of it
        if not path.exists():
            if any(root.iterdir()):
                raise DatasetError(f"{root}: not empty, and not begun by this command", next_step="Use a new folder")
            partial = root / f".{SOURCE_FILE}.part"
            partial.write_text(json.dumps(source, indent=2) + "\n", encoding="utf-8")
            partial.replace(path)
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DatasetError(f"{root}: cannot be used as a data set folder", got=error) from error
    if found != source:
        theirs = found if isinstance(found, dict) else {}
        if set(theirs) != set(source):
            raise DatasetError(f"{root}: holds what another command has made", next_step="Use a new folder")
        differ = [k for k in source if theirs.get(k) != source.get(k)]
        raise DatasetError(
            f"{root}: holds the data of another source or other settings",
            got=", ".join(f"{k} {json.dumps(theirs[k])}" for k in differ),
            allowed=", ".join(f"{k} {json.dumps(source[k])}" for k in differ),
            next_step=f"Use a new folder or remove {FILE}, {SOURCE_FILE} and the bags",
        )


def _read_npz(path: Path) -> DeformSource:
    wanted = ("positions", "split", "hz")
    try:
        with np.load(path, allow_pickle=False) as data:
            missing = [k for k in wanted if k not in data.files]
            if missing:
                raise DatasetError(f"{path}: not DEFORM data, no {', '.join(missing)}", got=", ".join(data.files))
            positions, hz = data["positions"], float(data["hz"])
            splits = data["split"].tolist()
            recordings = data["recording_id"].tolist() if "recording_id" in data.files else None
    except (OSError, EOFError, ValueError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path}: not an npz file", got=error, next_step="Give the npz or its folder") from error
    shape = positions.shape
    if positions.dtype.kind != "f" or len(shape) != 4 or shape[-1] != 3 or shape[0] < 1 or shape[1] < 2:
        raise DatasetError(f"{path}: positions", got=shape, allowed="(episode, 2 frames or more, vertex, 3) floats")
    if hz != RATE:
        raise DatasetError(f"{path}: hz", got=hz, allowed=RATE)
    lengths = {len(positions), len(splits), len(positions if recordings is None else recordings)}
    if len(lengths) != 1:
        raise DatasetError(f"{path}: arrays of different lengths", got=sorted(lengths))
    position = tuple(positions.astype(np.float64))
    return DeformSource(
        name=path.stem,
        position=position,
        split=tuple(_split(s, path) for s in splits),
        recording=group_recordings(position) if recordings is None else tuple(int(r) for r in recordings),
        origin=tuple(f"episode {i}" for i in range(len(position))),
        digest=file_sha256(path),
    )


def _read_folder(path: Path) -> DeformSource:
    files = [
        f for split in SPLITS for f in sorted((path / split).glob("*.pkl"), key=lambda f: (len(f.stem), f.stem))
    ]
    if not files:
        raise DatasetError(f"{path}: no episodes", got="no train/*.pkl or eval/*.pkl", next_step="Give data_set/DLO1")
    position = tuple(np.swapaxes(read_pickled_numbers(f), 1, 2) for f in files)
    shapes = {p.shape[1:] for p in position}
    if len(shapes) != 1:
        raise DatasetError(f"{path}: episodes of different cables", got=sorted(s[0] for s in shapes))
    digest = hashlib.sha256("".join(f"{f.name} {file_sha256(f)}\n" for f in files).encode()).hexdigest()
    return DeformSource(
        name=f"deform_{path.resolve().name.lower()}",
        position=position,
        split=tuple(_split(f.parent.name, path) for f in files),
        recording=group_recordings(position),
        origin=tuple(f"{f.parent.name}/{f.name}" for f in files),
        digest=digest,
    )


def _split(name: str, path: Path) -> str:
    if name not in SPLITS:
        raise DatasetError(f"{path}: unknown split", got=repr(name), allowed=", ".join(SPLITS))
    return SPLITS[name]

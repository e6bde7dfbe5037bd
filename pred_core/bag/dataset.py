"""A data set: a folder of bags and its `dataset.yaml`. Episodes are read when they are asked for."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pred_core.bag.episode import read_episode
from pred_core.bag.unseen import complete_line
from pred_core.config import from_mapping, load_yaml, setting, to_mapping
from pred_core.errors import ConfigError, DatasetError, nearest
from pred_core.types import STANDARD_GRAVITY, Episode, ObjectInfo

FILE = "dataset.yaml"
SPLITS = ("train", "test", "ood")
# [kg], [m], [m]. Other facts are allowed, near misses of these are not; `ground` [m], a height, has any sign.
KNOWN_FACTS = ("mass", "rest_length", "radius")


@dataclass(frozen=True)
class EpisodeEntry:
    """One line of `episodes`."""

    bag: str = setting(doc="file in the data set's folder")
    split: str = setting(choices=SPLITS, doc="what the episode is for")
    recording: int = setting(-1, low=-1, doc="groups episodes that must not be split; -1: a recording of its own")
    held: dict | None = dataclasses.field(  # type: ignore[type-arg]
        default=None, hash=False, metadata={"doc": "particle id -> gripper index, where it differs from the data set's"}
    )


@dataclass(frozen=True)
class DatasetConfig:
    """`dataset.yaml`."""

    object: ObjectInfo
    rate: float = setting(unit="Hz", low=0.1, high=10000.0, doc="rate of tracker/points")
    episodes: tuple[EpisodeEntry, ...] = setting((), doc="the bags")
    gravity: tuple[float, float, float] = setting(STANDARD_GRAVITY, unit="m/s^2", low=-100.0, high=100.0)
    sigma: float | None = setting(None, unit="m", low=0.0, high=0.1, doc="track noise, if known")
    held: dict | None = setting(None, doc="particle id -> gripper index")  # type: ignore[type-arg]
    known: dict | None = setting(None, doc="facts: mass [kg], rest_length [m], ...")  # type: ignore[type-arg]


@dataclass(frozen=True)
class Fold:
    """One fold of a grouped cross-validation."""

    train: tuple[EpisodeEntry, ...]
    test: tuple[EpisodeEntry, ...]


@dataclass(frozen=True)
class Dataset:
    """A data set on disk. `load_dataset` checks that it is complete; bags are read on demand."""

    root: Path
    object: ObjectInfo
    rate: float  # [Hz]
    gravity: tuple[float, float, float]  # [m/s^2] world
    sigma: float | None  # [m]
    held: dict[int, int] | None  # particle id -> gripper index
    known: dict[str, Any]
    entries: tuple[EpisodeEntry, ...]

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits that have episodes."""
        return tuple(s for s in SPLITS if any(e.split == s for e in self.entries))

    def select(self, split: str | None = None) -> tuple[EpisodeEntry, ...]:
        """The entries of a split (None: all). Raises: DatasetError if there are none."""
        if split is not None and split not in SPLITS:
            raise DatasetError(f"{self.root}: unknown split", got=split, allowed=", ".join(SPLITS))
        chosen = tuple(e for e in self.entries if split in (None, e.split))
        if not chosen:
            raise DatasetError(
                f"{self.root}: split '{split}' is empty",
                got=f"episodes only in {', '.join(self.splits) or 'no split'}",
                next_step=f"Give some episodes 'split: {split}' in {FILE}",
            )
        return chosen

    def read(self, entry: EpisodeEntry) -> Episode:
        """The episode of an entry, a line's never measured particles estimated (`complete_line`). Raises: BagError."""
        episode = read_episode(
            self.root / entry.bag,
            name=Path(entry.bag).stem,
            object=self.object,
            held=self.held if entry.held is None else entry.held,
            gravity=self.gravity,
            split=entry.split,
            recording=entry.recording,
            rate=self.rate,
        )
        return complete_line(episode, self.known)

    def episodes(self, split: str | None = None, entries: Iterable[EpisodeEntry] | None = None) -> Iterator[Episode]:
        """Episodes of a split (None: all), or of given entries, read one by one.

        Raises: DatasetError at once if the split is empty; BagError when a bag is read.
        """
        chosen = self.select(split) if entries is None else tuple(entries)
        return (self.read(entry) for entry in chosen)

    def sha256(self, entry: EpisodeEntry) -> str:
        """Hash of the bag file of an entry, hex."""
        return file_sha256(self.root / entry.bag)

    def grouped_folds(self, k: int) -> tuple[Fold, ...]:
        """k folds over train and test episodes; all episodes of a recording fall into one fold.

        The largest recordings are dealt first, each to the smallest fold so far: the same folds every time.
        Raises: DatasetError if there are fewer recordings than folds.
        """
        entries = [e for e in self.entries if e.split != "ood"]
        groups: dict[int, list[EpisodeEntry]] = {}
        for entry in entries:
            groups.setdefault(entry.recording, []).append(entry)
        if not 2 <= k <= len(groups):
            raise DatasetError(f"{self.root}: cannot make folds", got=k, allowed=f"2 to {len(groups)} (recordings)")
        folds: list[set[int]] = [set() for _ in range(k)]
        sizes = [0] * k
        for recording, members in sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])):
            smallest = sizes.index(min(sizes))
            folds[smallest].add(recording)
            sizes[smallest] += len(members)
        return tuple(
            Fold(
                tuple(e for e in entries if e.recording not in fold),
                tuple(e for e in entries if e.recording in fold),
            )
            for fold in folds
        )


def load_dataset(path: Path | str) -> Dataset:
    """Load a data set folder (or its dataset.yaml).

    Raises: ConfigError for an unknown key or bad value; DatasetError if the folder or a bag is missing.
    """
    root = Path(path)
    if root.name == FILE:
        root = root.parent
    if not (root / FILE).is_file():
        raise DatasetError(
            f"{root}: not a data set",
            got="no such folder" if not root.exists() else f"no {FILE} in it",
            next_step="Make one with 'pred convert', or write one (bags/README.md)",
        )
    source = str(root / FILE)
    config = from_mapping(DatasetConfig, load_yaml(root / FILE) or {}, source)
    if not config.episodes:
        raise DatasetError(f"{source}: no episodes", next_step="List at least one bag under 'episodes'")
    bags = [e.bag for e in config.episodes]
    for bag in bags:
        if Path(bag).is_absolute() or ".." in Path(bag).parts:
            raise DatasetError(f"{source}: bag '{bag}'", allowed="a path inside the data set's folder")
        if bags.count(bag) > 1:
            raise DatasetError(f"{source}: bag '{bag}' is listed twice", allowed="each bag once")
    for entry in config.episodes:
        _checked_held(entry.held, f"{source}: {entry.bag}")
    missing = [bag for bag in bags if not (root / bag).exists()]
    if missing:
        raise DatasetError(
            f"{source}: {len(missing)} of {len(bags)} episodes are missing",
            got="no file " + ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else ""),
            next_step="Copy the bags beside dataset.yaml or remove their lines",
        )
    return Dataset(
        root=root,
        object=config.object,
        rate=config.rate,
        gravity=config.gravity,
        sigma=config.sigma,
        held=_checked_held(config.held, source),
        known=_checked_known(config.known, source),
        entries=_with_recordings(config.episodes),
    )


def write_dataset(
    root: Path | str,
    *,
    object: ObjectInfo,
    rate: float,
    entries: Sequence[EpisodeEntry],
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
    sigma: float | None = None,
    held: Mapping[int, int] | None = None,
    known: Mapping[str, Any] | None = None,
) -> Dataset:
    """Write `dataset.yaml` beside bags that are already in `root`, and load the result."""
    plain: dict[str, Any] = {"object": to_mapping(object), "rate": float(rate), "gravity": [float(g) for g in gravity]}
    if sigma is not None:
        plain["sigma"] = float(sigma)
    if held is not None:
        plain["held"] = {int(k): int(v) for k, v in held.items()}
    if known:
        plain["known"] = dict(known)
    plain["episodes"] = [{k: v for k, v in to_mapping(e).items() if k != "held" or v is not None} for e in entries]
    path = Path(root) / FILE
    partial = path.with_name(f".{FILE}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(yaml.safe_dump(plain, sort_keys=False), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written", got=error) from error
    return load_dataset(root)


def file_sha256(path: Path) -> str:
    """Hash of a file, hex, read in pieces."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read", got=error) from error


def _checked_held(held: Mapping[Any, Any] | None, source: str) -> dict[int, int] | None:
    if held is None:
        return None
    for particle, gripper in held.items():
        for value in (particle, gripper):
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise ConfigError(f"{source}: held", got=f"{particle!r}: {gripper!r}", allowed="id: gripper, both >= 0")
    return dict(held)


def _checked_known(known: Mapping[Any, Any] | None, source: str) -> dict[str, Any]:
    for key, value in (known or {}).items():
        hint = nearest(str(key), KNOWN_FACTS)
        if key not in KNOWN_FACTS and hint.startswith("did you mean"):
            raise ConfigError(f"{source}: unknown key '{key}' in known", next_step=hint)
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, bool) or not isinstance(number, (int, float)) or not math.isfinite(number):
                raise ConfigError(f"{source}: known {key}", got=repr(value), allowed="finite numbers")
            if key in KNOWN_FACTS and number <= 0:
                raise ConfigError(f"{source}: known {key}", got=number, allowed="above 0")
    return dict(known or {})


def _with_recordings(entries: Sequence[EpisodeEntry]) -> tuple[EpisodeEntry, ...]:
    """Give entries without a recording one of their own."""
    free = max((e.recording for e in entries), default=-1) + 1
    result = []
    for entry in entries:
        if entry.recording < 0:
            entry, free = dataclasses.replace(entry, recording=free), free + 1
        result.append(entry)
    return tuple(result)

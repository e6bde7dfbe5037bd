"""Where measured data are found: PRED_DATA, else data/, else ../shared/data. They are never in the repository."""

from __future__ import annotations

import os
from pathlib import Path

from pred_core.errors import ConfigError, DatasetError

SUFFIXES = ("", ".npz", ".mcap")
_REPOSITORY = Path(__file__).resolve().parents[2]


def search_path() -> tuple[Path, ...]:
    """The folders searched, in order. Raises: ConfigError if PRED_DATA is set but is no folder."""
    folders = []
    chosen = os.environ.get("PRED_DATA")
    if chosen:
        if not Path(chosen).is_dir():
            raise ConfigError("PRED_DATA names no folder", got=chosen, next_step="Unset it or correct it")
        folders.append(Path(chosen))
    for root in (Path.cwd(), _REPOSITORY):
        folders += [root / "data", root.parent / "shared" / "data"]
    return tuple(dict.fromkeys(f.resolve() for f in folders))


def find_measured(name: str) -> Path | None:
    """The measured file or data set `name` (`deform_dlo1`, with or without suffix), or None."""
    for folder in search_path():
        for suffix in SUFFIXES:
            path = folder / f"{name}{suffix}"
            if path.exists():
                return path
    return None


def measured_or_explain(name: str) -> Path:
    """`find_measured`, or a DatasetError that says where was searched and what to do."""
    path = find_measured(name)
    if path is None:
        raise DatasetError(
            f"no measured data '{name}' found",
            got="nothing in " + ", ".join(str(f) for f in search_path()),
            next_step="Set PRED_DATA to the folder that holds it (README.md, 'measured data')",
        )
    return path

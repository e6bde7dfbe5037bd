"""Finished pieces of a diagnosis on disk, so that it can be interrupted and goes on exactly."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pred_core.errors import ConfigError
from pred_core.types import Array

T = TypeVar("T")


class Journal:
    """One JSON line a finished piece, under a header that tells the diagnosis (data, twin, settings).

    A journal of another diagnosis is put aside as `journal.old.jsonl`: the folder may be used again. A last line cut
    off in writing is dropped. Nothing is written before a piece is finished.

    Raises: ConfigError if the file is damaged.
    """

    def __init__(self, path: Path | None, header: dict[str, Any]):
        self.path = path
        self.known: dict[str, Any] = {}
        self.replayed = 0
        self._begin: str | None = None  # what the file must hold before the next piece; None: it does
        self._other = False  # the file is of another diagnosis
        if path is None:
            return
        line = json.dumps({"header": header}, sort_keys=True)
        path.parent.mkdir(parents=True, exist_ok=True)  # a folder that cannot be is told at once
        try:
            text = path.read_text(encoding="utf-8") if path.is_file() else ""
        except UnicodeDecodeError as error:
            raise ConfigError(f"{path}: is damaged", got=error, next_step="Delete it to begin anew") from error
        whole = text[: text.rfind("\n") + 1]
        rows = whole.splitlines()
        if rows and rows[0] == line:
            try:
                for row in rows[1:]:
                    entry = json.loads(row)
                    self.known[entry["key"]] = entry["value"]
            except (json.JSONDecodeError, KeyError, TypeError) as error:
                raise ConfigError(f"{path}: is damaged", got=error, next_step="Delete it to begin anew") from error
        else:
            self._other = bool(rows)
            whole = line + "\n"
        self._begin = None if whole == text else whole

    def once(self, key: str, make: Callable[[], Any]) -> Any:
        """The stored value of a piece, or the plain value `make` gives, stored."""
        if key in self.known:
            self.replayed += 1
            return self.known[key]
        value = json.loads(json.dumps(make()))
        self.known[key] = value
        if self.path is not None:
            self._prepare(self.path)
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"key": key, "value": value}) + "\n")
        return value

    def _prepare(self, path: Path) -> None:
        """Put another diagnosis' journal aside, drop a line that was cut off, write the header."""
        if self._begin is None:
            return
        if self._other:
            path.replace(path.with_name("journal.old.jsonl"))
        path.write_text(self._begin, encoding="utf-8")
        self._begin = None

    def piece(self, key: str, make: Callable[[], Any], read: Callable[[Any], T]) -> T:
        """What `read` makes of a piece. Raises: ConfigError if a stored value is not one that `read` knows."""
        stored = key in self.known
        value = self.once(key, make)
        if not stored:
            return read(value)
        try:
            return read(value)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise ConfigError(
                f"{self.path}: the value of '{key}' is damaged", got=f"{type(error).__name__}: {error}",
                next_step="Delete the file to begin anew",
            ) from error  # fmt: skip


def vector(values: Any, size: int) -> Array:
    """Plain numbers as (size,). Raises: ValueError if they are not as many, or not finite."""
    found = np.array(values, dtype=np.float64)
    if found.shape != (size,) or not np.isfinite(found).all():
        raise ValueError(f"{found.shape} values, expected {size} finite ones")
    return found

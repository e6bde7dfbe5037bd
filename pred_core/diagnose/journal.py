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
    off in writing is dropped. Raises: ConfigError if the file is damaged.
    """

    def __init__(self, path: Path | None, header: dict[str, Any]):
        self.path = path
        self.known: dict[str, Any] = {}
        self.replayed = 0
        if path is None:
            return
        line = json.dumps({"header": header}, sort_keys=True)
        path.parent.mkdir(parents=True, exist_ok=True)
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
            if rows:
                path.replace(path.with_name("journal.old.jsonl"))
            whole = line + "\n"
        path.write_text(whole, encoding="utf-8")

    def once(self, key: str, make: Callable[[], Any]) -> Any:
        """The stored value of a piece, or the plain value `make` gives, stored."""
        if key in self.known:
            self.replayed += 1
            return self.known[key]
        value = json.loads(json.dumps(make()))
        self.known[key] = value
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"key": key, "value": value}) + "\n")
        return value

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

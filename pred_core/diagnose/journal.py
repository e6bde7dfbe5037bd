"""Finished pieces of a diagnosis on disk, so that it can be interrupted and goes on exactly."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pred_core.errors import ConfigError
from pred_core.types import Array

T = TypeVar("T")
PutAside = Callable[[Path, dict[str, Any] | None], None]  # where another's journal went, its header if it can be read


class Journal:
    """One JSON line a finished piece, under a header that tells the diagnosis (data, twin, settings).

    A journal of another diagnosis is put aside as `journal.old1.jsonl`, or the next number that is free: the folder may
    be used again. A last line cut off in writing is dropped. Nothing is written or put aside before a piece is
    finished.

    Raises: ConfigError if the file is damaged.
    """

    def __init__(self, path: Path | None, header: dict[str, Any], put_aside: PutAside | None = None):
        self.path = path
        self.known: dict[str, Any] = {}
        self.replayed = 0
        self.found = False  # there is a journal in the folder, of this diagnosis or another
        self._put_aside = put_aside
        self._begin: str | None = None  # what the file must hold before the next piece; None: it does
        self._other: str | None = None  # the first line of another diagnosis' file
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
        self.found = bool(rows)
        if rows and rows[0] == line:
            try:
                for row in rows[1:]:
                    entry = json.loads(row)
                    self.known[entry["key"]] = entry["value"]
            except (json.JSONDecodeError, KeyError, TypeError) as error:
                raise ConfigError(f"{path}: is damaged", got=error, next_step="Delete it to begin anew") from error
        else:
            self._other = rows[0] if rows else None
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
        if self._other is not None:
            aside = _free(path)
            path.replace(aside)
            if self._put_aside is not None:
                self._put_aside(aside, _header_in(self._other))
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


def _free(path: Path) -> Path:
    """`journal.old1.jsonl` beside the journal, or the first number that no file has."""
    names = (path.with_name(f"{path.stem}.old{n}{path.suffix}") for n in itertools.count(1))
    return next(p for p in names if not p.exists())


def _header_in(line: str) -> dict[str, Any] | None:
    try:
        header = json.loads(line)["header"]
    except (json.JSONDecodeError, KeyError, TypeError):
        return None
    return header if isinstance(header, dict) else None


def vector(values: Any, size: int) -> Array:
    """Plain numbers as (size,). Raises: ValueError if they are not as many, or not finite."""
    found = np.array(values, dtype=np.float64)
    if found.shape != (size,) or not np.isfinite(found).all():
        raise ValueError(f"{found.shape} values, expected {size} finite ones")
    return found

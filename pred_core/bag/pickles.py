"""Reads pickled nested lists of numbers, and nothing else: no class, no function, no string is ever built."""

from __future__ import annotations

import io
import pickle
import pickletools
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import DatasetError

LARGEST_FILE = 100 << 20  # [bytes]; an episode of the source has about 200 kB
LARGEST_MEMO = 1 << 22  # a memo index beyond it only makes the unpickler allocate memory

# Everything lists, tuples and numbers need. What builds objects (GLOBAL, REDUCE, BUILD, ...) is not here.
_NUMBERS = {"INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "FLOAT", "BINFLOAT"}
_LISTS = {"MARK", "LIST", "EMPTY_LIST", "APPEND", "APPENDS"}
_TUPLES = {"TUPLE", "EMPTY_TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"}
_MEMO = {"PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE", "GET", "BINGET", "LONG_BINGET"}
_ALLOWED = _NUMBERS | _LISTS | _TUPLES | _MEMO | {"PROTO", "FRAME", "STOP"}

_UNPICKLER_ERRORS = (
    pickle.UnpicklingError, EOFError, ValueError, TypeError, IndexError, KeyError, AttributeError, MemoryError,
)  # fmt: skip


def read_pickled_numbers(path: Path) -> NDArray[np.float64]:
    """The array of a pickle of nested lists. Raises: DatasetError if it holds anything but numbers in even lists."""
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise DatasetError(f"{path}: too large for one episode", got=f"{size} bytes", allowed=f"{LARGEST_FILE}")
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read", got=error) from error
    _check_opcodes(data, path)
    try:
        nested = _ListsOnly(io.BytesIO(data)).load()
    except _UNPICKLER_ERRORS as error:
        raise DatasetError(f"{path}: not a pickle of nested lists", got=error) from error
    return np.array(_checked(nested, path), np.float64)


class _ListsOnly(pickle.Unpickler):
    """Second lock behind `_check_opcodes`: no name is ever looked up."""

    def find_class(self, module: str, name: str) -> NoReturn:
        raise pickle.UnpicklingError(f"{module}.{name} refused")

    def persistent_load(self, pid: object) -> NoReturn:
        raise pickle.UnpicklingError("a reference to another file refused")


def _check_opcodes(data: bytes, path: Path) -> None:
    try:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name not in _ALLOWED:
                raise DatasetError(
                    f"{path}: the pickle holds more than lists and numbers",
                    got=f"{opcode.name} {argument!r}"[:120] if argument is not None else opcode.name,
                    next_step="Unpickling it could run code, so it is refused; save nested lists of floats",
                )
            if opcode.name in _MEMO and isinstance(argument, int) and argument > LARGEST_MEMO:
                raise DatasetError(f"{path}: not a plausible pickle", got=f"memo index {argument}")
    except DatasetError:
        raise
    except _UNPICKLER_ERRORS as error:
        raise DatasetError(f"{path}: not a pickle", got=error) from error


def _checked(nested: Any, path: Path) -> Any:
    """`nested` if it is frames x 3 x vertices of finite numbers, else a DatasetError."""

    def refuse(problem: str) -> DatasetError:
        return DatasetError(f"{path}: {problem}", allowed="nested lists [frame][3][vertex] of finite numbers [m]")

    if not isinstance(nested, (list, tuple)) or len(nested) < 2:
        raise refuse("not a list of at least two frames")
    count: int | None = None
    for t, frame in enumerate(nested):
        if not isinstance(frame, (list, tuple)) or len(frame) != 3:
            raise refuse(f"frame {t} is not a list of 3 coordinates")
        for axis in frame:
            if not isinstance(axis, (list, tuple)):
                raise refuse(f"frame {t} does not hold lists of vertices")
            count = len(axis) if count is None else count
            if len(axis) != count or count == 0:
                raise refuse(f"frame {t} has {len(axis)} vertices, the first has {count}")
            for value in axis:
                if isinstance(value, bool) or not isinstance(value, (int, float)):
                    raise refuse(f"frame {t} holds a {type(value).__name__}")
                if not abs(value) < 1e300:
                    raise refuse(f"frame {t} holds {value}")
    return nested

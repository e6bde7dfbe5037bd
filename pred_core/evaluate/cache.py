"""Predictions already made, so that an interrupted evaluation goes on where it stopped."""

from __future__ import annotations

import hashlib
import os
import sys
import zipfile
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

import pred_core
from pred_core.types import Array

# Packages that cannot change a prediction, and the files of this one that can.
_NO_INFLUENCE = {"evaluate", "cli", "report", "identify", "diagnose", "plan", "plant", "metrics"}
# What numpy and zipfile raise for files that were cut off or changed.
_DAMAGE = (OSError, EOFError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)
_PROTOCOL = {("evaluate", "protocol.py"), ("evaluate", "models.py")}


@cache
def code_digest() -> str:
    """sha256 over the sources of this package: predictions of another version are never reused."""
    root = Path(pred_core.__file__).parent
    sha = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).parts
        if parts[0] not in _NO_INFLUENCE or parts in _PROTOCOL:
            sha.update(path.read_bytes())
    return sha.hexdigest()


def tell_damaged(path: Path, why: object) -> None:
    """One line on stderr; what the file held is computed again."""
    print(f"pred: {path}: damaged, computed again ({why})", file=sys.stderr)


class PredictionCache:
    """One file a model and fold under `folder`, named by the hash of everything it depends on."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def key(self, model: str, fold: str, fold_index: int | None) -> str:
        """Hash of model digest, fold digest and code."""
        return hashlib.sha256(f"{model}\n{fold}\n{fold_index}\n{code_digest()}".encode()).hexdigest()[:32]

    def load(self, key: str, shapes: Sequence[tuple[int, ...]]) -> list[Array] | None:
        """The predictions of `key`, of the given shapes, or None. A damaged file counts as none and is told."""
        path = self.folder / f"{key}.npz"
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as data:
                found = [data[name].astype(np.float64) for name in sorted(data.files)]
        except _DAMAGE as error:
            tell_damaged(path, error)
            return None
        if [f.shape for f in found] != list(shapes):
            tell_damaged(path, f"{len(found)} predictions of other shapes than the {len(shapes)} episodes")
            return None
        return found

    def store(self, key: str, predictions: list[Array]) -> None:
        """Write as float32, whole or not at all."""
        temporary = self.folder / f"{key}.partial.npz"
        arrays = {f"episode_{i:06d}": p.astype(np.float32) for i, p in enumerate(predictions)}
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]
        os.replace(temporary, self.folder / f"{key}.npz")

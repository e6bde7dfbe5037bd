"""What a diagnosis is asked: data, twin and settings; whether they fit together, and what differs from another's."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pred_core.bag.dataset import FILE, Dataset, EpisodeEntry
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.errors import DatasetError, TwinError
from pred_core.twin import Twin

VERSION = 5  # of the journal's pieces
ELSEWHERE = ("arm", "cli", "estimate", "live", "plan", "plant", "report", "track")  # no answer comes from them
GRAVITY_APART = 0.01 * 9.81  # [m/s^2] declared gravities may differ by, as vectors: 0.6 degrees of tilt
SHOWN = 5  # bags in a line
_FALLBACK = "what it was asked cannot be read"


def job_of(dataset: Dataset, reference: Dataset | None, twin: Twin, config: DiagnoseConfig) -> dict[str, Any]:
    """The header of the journal: the same job has the same, whatever its folders are called and how long it may take.

    Raises: DatasetError if a data set has a recording under two names, if a bag of the reference is one of the data
    set's too, or if one cannot be read.
    """
    sets = [dataset] if reference is None else [dataset, reference]
    hashes = [[s.sha256(e) for e in s.entries] for s in sets]
    for one, mine in zip(sets, hashes, strict=True):
        _check_twice(one, mine)
    if reference is not None:
        _check_shared(dataset, reference, hashes)
    facts = [repr((s.entries, s.held, s.gravity, s.known, s.sigma)) for s in sets]
    plain = dataclasses.replace(config, seconds=DiagnoseConfig().seconds)
    asked = {"twin": twin.digest(), "levers": repr(twin.meta.levers), "config": repr(plain), "version": VERSION}
    asked["code"] = code_digest()
    return {"data": hashes, "facts": facts, **asked}


@functools.cache
def code_digest() -> str:
    """Of the sources an answer may come from: pieces of two versions are not one answer. Reports are drawn anew."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in ELSEWHERE and not name.name.startswith(("report", "picture")):
            digest.update(name.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def check_gravity(dataset: Dataset, reference: Dataset | None, twin: Twin, path: Path) -> None:
    """Everything is simulated with the twin's gravity, so what the data sets declare must be the same.

    `path`: of the twin, as typed. Raises: TwinError, DatasetError that name both vectors.
    """
    allowed = f"{GRAVITY_APART:.3g} m/s^2 apart at most"
    if _apart(dataset.gravity, twin.scene.gravity):
        raise TwinError(
            f"{dataset.root}: its gravity contradicts the twin's",
            got=f"{_vector(dataset.gravity)} in {FILE}, {_vector(twin.scene.gravity)} in {path / 'twin.yaml'}",
            allowed=allowed,
            next_step=f"Correct 'gravity' in {FILE}, or identify the twin on this data: pred identify "
            f"{dataset.root} --out TWIN",
        )
    if reference is not None and _apart(reference.gravity, dataset.gravity):
        raise DatasetError(
            f"reference {reference.root}: its gravity contradicts the data set's",
            got=f"{_vector(reference.gravity)} in {reference.root / FILE}, {_vector(dataset.gravity)} in "
            f"{dataset.root / FILE}",
            allowed=allowed,
            next_step=f"Correct 'gravity' in the {FILE} that is wrong, or give another --reference",
        )


def differences(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> str:
    """What another job's header has otherwise, in a few words: "level 0.05, now 0.1; another twin"."""
    try:
        return "; ".join(_differences(before or {}, now)) or _FALLBACK
    except (KeyError, IndexError, TypeError):  # a header of another version, or of no diagnosis
        return _FALLBACK


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    found = []
    if len(before["data"]) != len(now["data"]):
        found.append("without a reference, now with one" if len(now["data"]) == 2 else "with a reference, now without")
    for n, name in enumerate(("data set", "reference")[: min(len(before["data"]), len(now["data"]))]):
        if before["data"][n] != now["data"][n]:
            found.append(f"other bags in the {name}")
        elif before["facts"][n] != now["facts"][n]:
            found.append(f"another {FILE} of the {name}")
    if before["twin"] != now["twin"] or before["levers"] != now["levers"]:
        found.append("another twin")
    old, new = (dict(re.findall(r"(\w+)=([^,()]+)", str(h["config"]))) for h in (before, now))
    found += [f"{k} {old.get(k, 'unknown')}, now {v}" for k, v in new.items() if old.get(k) != v]
    if (before["version"], before.get("code")) != (now["version"], now["code"]):
        found.append("written by another version")
    return found


def _check_twice(dataset: Dataset, hashes: list[str]) -> None:
    """What is fitted cannot be held out too, and what counts twice makes every interval too narrow."""
    first: dict[str, EpisodeEntry] = {}
    for entry, hash in zip(dataset.entries, hashes, strict=True):
        other = first.setdefault(hash, entry)
        if other is not entry:
            raise DatasetError(
                f"{dataset.root}: one recording is listed twice",
                got=f"{other.bag} ({other.split}) and {entry.bag} ({entry.split}) with the same content",
                allowed="every recording once",
                next_step=f"Remove one of them from {FILE}",
            )


def _check_shared(dataset: Dataset, reference: Dataset, hashes: list[list[str]]) -> None:
    theirs = dict(zip(hashes[1], (e.bag for e in reference.entries), strict=True))
    shared = [(e.bag, theirs[h]) for e, h in zip(dataset.entries, hashes[0], strict=True) if h in theirs]
    if not shared:
        return
    names = [ours if ours == other else f"{ours} (there {other})" for ours, other in shared]
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    raise DatasetError(
        f"reference {reference.root}: the same recordings as in the data set {dataset.root} show no change",
        got=f"{len(names)} of {len(dataset.entries)} bags in both: {', '.join(names[:SHOWN])}{more}",
        allowed="other recordings, without what is looked for",
        next_step="Give another --reference, or leave it out to diagnose the data set on its own",
    )


def _apart(one: tuple[float, float, float], other: tuple[float, float, float]) -> bool:
    return bool(np.linalg.norm(np.subtract(one, other)) > GRAVITY_APART)


def _vector(gravity: tuple[float, float, float]) -> str:
    return f"[{', '.join(f'{g:g}' for g in gravity)}] m/s^2"

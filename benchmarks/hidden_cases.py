"""Which cases the benchmark of hidden effects has: effects, magnitudes and seeds, drawn; references beside them.

Development cases chose what is frozen in the code. Seen cases were answered by earlier versions of the engine and
looked at, so they are development cases too. Final cases have other seeds, so other motions, noise, directions, places
and magnitudes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pred_core.plant.hidden.library import LIBRARY
from pred_core.plant.rope_case import Hidden, write_rope_case
from pred_core.plant.session import SessionConfig

SESSION = SessionConfig(train=12, test=4, ood=3, seconds=4.0)
SETS = ("final", "seen", "dev", "extents")
SIZED = ("attraction", "sticky_patch", "gripper_slip", "heavy_tip", "stiff_region")  # their size starts a search too
REFERENCES = (50000, 51000, 52000, 53000)
# Draws that were looked at: seeds of the cases from, seed of the draw, controls, how many of its cases. (case52000 has
# the seed of a reference, which was not its own.)
SEEN = (
    (50100, 2, 40, 29), (50200, 3, 42, 106), (50500, 4, 40, 34), (50700, 5, 40, 64), (51100, 6, 40, 78),
    (51400, 7, 40, 102), (51600, 8, 40, 102), (51900, 10, 40, 102), (52100, 11, 40, 102),
)  # fmt: skip
LEAST, MOST = 2.0, 10.0  # magnitudes, in multiples of the effect's declared minimum, log-uniform


@dataclass(frozen=True)
class Case:
    """One data set with something hidden in it, or nothing."""

    name: str
    seed: int
    hidden: Hidden
    reference: str  # name of the reference it is diagnosed with
    extent: float = 1.0  # times the usual size in space of what is hidden


@dataclass(frozen=True)
class Release:
    """References, each by its seed, and the cases diagnosed with them in turn."""

    references: Mapping[str, int]
    cases: tuple[Case, ...]


def cases(first: int, seed: int, controls: int, singles: int, unlisted: int, pairs: int) -> list[tuple[int, Hidden]]:
    """(seed, what is hidden) of every case, shuffled; seeds count up from first + 1."""
    generator = np.random.default_rng(seed)
    listed = [n for n, e in LIBRARY.items() if not e.unlisted]
    others = [n for n, e in LIBRARY.items() if e.unlisted]

    def magnitude(name: str) -> float:
        entry = LIBRARY[name]
        factor = float(np.exp(generator.uniform(np.log(LEAST), np.log(MOST))))
        return min(entry.minimum * factor, entry.high)

    def in_turn(names: list[str], count: int) -> list[str]:
        order: list[str] = []
        while len(order) < count:
            order += [names[i] for i in generator.permutation(len(names))]
        return order[:count]

    rows: list[Hidden] = [()] * controls
    rows += [((n, magnitude(n)),) for n in in_turn(listed, singles)]
    rows += [((n, magnitude(n)),) for n in in_turn(others, unlisted)]
    for _ in range(pairs):
        a, b = (listed[i] for i in generator.choice(len(listed), 2, replace=False))
        rows.append(((a, magnitude(a)), (b, magnitude(b))))
    order = generator.permutation(len(rows)).tolist()
    return [(first + 1 + i, rows[j]) for i, j in enumerate(order)]


def _release(references: tuple[int, ...], drawn: list[tuple[int, Hidden]]) -> Release:
    names = [f"ref{r}" for r in references]
    return Release(
        dict(zip(names, references, strict=True)),
        tuple(Case(f"case{s}", s, h, names[n % len(names)]) for n, (s, h) in enumerate(drawn)),
    )


def release(which: str) -> Release:
    """One of SETS. "dev": chose what is frozen; "seen": looked at since; "final": not run before it is reported;
    "extents": what has a size, smaller and larger than where a search for it begins."""
    if which == "dev":
        return _release((7000,), cases(7100, 1, 8, 26, 7, 4))
    if which == "seen":
        drawn = [cases(first, seed, n, n + 6, 10, 6)[:looked] for first, seed, n, looked in SEEN]
        parts = [_release(REFERENCES, d) for d in drawn]
        return Release(parts[0].references, tuple(c for p in parts for c in p.cases))
    if which == "extents":
        factors = np.exp(np.random.default_rng(9).uniform(np.log(4.0), np.log(MOST), len(SIZED)))
        rows = [(LIBRARY[n], float(f)) for n, f in zip(SIZED, factors, strict=True)]
        both = [(e.name, min(e.minimum * f, e.high), extent) for e, f in rows for extent in (0.6, 1.6)]
        sized = _release(REFERENCES, [(51801 + k, ((n, m),)) for k, (n, m, _) in enumerate(both)])
        found = (dataclasses.replace(c, extent=e) for c, (_, _, e) in zip(sized.cases, both, strict=True))
        return Release(sized.references, tuple(found))
    return _release(REFERENCES, cases(52300, 12, 40, 46, 10, 6))


def simulate(root: Path, hidden: Hidden, seed: int, extent: float = 1.0) -> None:
    """Write the data set, unless it is finished."""
    if not (root / "dataset.yaml").exists():
        write_rope_case(root, hidden, seed, lambda done, total, name: None, session=SESSION, extent=extent)

"""The twin as it was given, and the base that causes are looked for beside: its own numbers, refined first."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pred_core.effects import find_effect
from pred_core.twin import Twin

MOVED = 0.05  # relative change of a number of the twin from which refining has moved it
OFF = 0.25  # share of the given twin's error that refining its own numbers takes away, from which that is said first


@dataclass(frozen=True)
class Refined:
    """What refining the given twin changed."""

    on: str  # what it was refined on, in words
    given: float | None  # [mm] error of the given twin on the episodes of `Errors`; None: not replayed, it takes long
    base: float  # [mm] of the base
    moved: Mapping[str, tuple[float, float, str]]  # parameter -> given, refined, unit; those that moved

    @property
    def off(self) -> bool:
        """The given twin errs so much more that it is the first thing to be told."""
        return self.given is not None and bool(self.moved) and self.base < (1.0 - OFF) * self.given

    def to_json(self) -> dict[str, Any]:
        """Both errors, and what moved."""
        return {
            "refined_on": self.on,
            "given_mm": self.given,
            "refined_mm": self.base,
            "parameters": {k: {"given": a, "refined": b, "unit": u} for k, (a, b, u) in self.moved.items()},
        }


def moved(given: Twin, base: Twin) -> dict[str, tuple[float, float, str]]:
    """Numbers of a twin -> as given, refined, unit; those that refining moved by MOVED or more."""
    rows = {
        f.name: (float(getattr(given.physics, f.name)), float(getattr(base.physics, f.name)), str(f.metadata["unit"]))
        for f in dataclasses.fields(given.physics)
    }
    for one, other in zip(given.extensions, base.extensions, strict=True):
        for q in find_effect(one.id).parameters:
            pairs = zip(one.parameters[q.name], other.parameters[q.name], strict=True)
            rows |= {
                f"{one.id}.{q.name}{f'[{n}]' if q.size > 1 else ''}": (a, b, q.unit) for n, (a, b) in enumerate(pairs)
            }
    return {k: (a, b, u) for k, (a, b, u) in rows.items() if abs(b - a) >= MOVED * max(abs(a), abs(b)) and a != b}


def moved_in_words(r: Refined) -> str:
    """The numbers of the twin that refining moved, "stiffness 60 to 20.1 N"."""
    rows = []
    for k, (a, b, unit) in r.moved.items():
        effect, _, name = k.rpartition(".")
        words = f"{name} of {effect}" if effect else name
        rows.append(f"{words.replace('_', ' ')} {a:.3g} to {b:.3g}{f' {unit}' if unit not in ('', '1') else ''}")
    return ", ".join(rows)


def refining_said(r: Refined, split: str) -> str:
    """What the base is, as a note."""
    text = f"base: your twin refined on {r.on}, not as it was given"
    if r.given is not None:
        text += f": on the {split} episodes {r.given:.1f} mm as given, {r.base:.1f} mm refined"
    return f"{text} ({moved_in_words(r)})" if r.moved else text

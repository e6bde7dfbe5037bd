"""The table of hidden effects. Adding one is a class or a line in its file; it appears here by itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from pred_core.errors import ConfigError, nearest
from pred_core.plant.hidden import air, boundary, ground, material, measurement
from pred_core.plant.hidden.effect import Entry, HiddenEffect

NONE = "none"
EXTENTS = (0.4, 2.5)
_MODULES = (air, ground, material, boundary, measurement)
LIBRARY: Mapping[str, Entry] = MappingProxyType({e.name: e for m in _MODULES for e in m.ENTRIES})


def find_entry(name: str) -> Entry:
    """The table's line of that name. Raises: ConfigError that offers the nearest name."""
    if name not in LIBRARY:
        raise ConfigError(f"unknown hidden effect '{name}'", next_step=nearest(name, [*LIBRARY, NONE]))
    return LIBRARY[name]


def check_magnitude(entry: Entry, magnitude: float) -> None:
    """Raise ConfigError unless the magnitude is finite and in the effect's range."""
    if not (math.isfinite(magnitude) and entry.low <= magnitude <= entry.high):
        raise ConfigError(
            f"magnitude of {entry.name}",
            got=f"{magnitude:g} {entry.unit}",
            allowed=f"{entry.low:g} to {entry.high:g} {entry.unit}",
        )


def make_effect(name: str, magnitude: float, seed: int, place: int = 0, extent: float = 1.0) -> HiddenEffect:
    """The effect; directions and places come from the seed, and from its place where several are hidden.

    extent: times its usual range, radius or share of the rope, and a slip's damping; others have none.
    Raises: ConfigError.
    """
    entry = find_entry(name)
    check_magnitude(entry, magnitude)
    check_extent(extent)
    effect = entry.make(magnitude, np.random.default_rng([seed, 2, place]))
    effect.extent = extent
    return effect


def check_extent(extent: float) -> None:
    """Raise ConfigError unless it is in EXTENTS."""
    if not EXTENTS[0] <= extent <= EXTENTS[1]:
        raise ConfigError("extent", got=f"{extent:g}", allowed=f"{EXTENTS[0]:g} to {EXTENTS[1]:g} times the usual")

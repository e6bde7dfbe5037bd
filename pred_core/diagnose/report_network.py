"""Parts of reports about networks: what one would hide, and what it is worth beside the causes that were named."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pred_core.diagnose.guard import OPEN, Guard
from pred_core.diagnose.guard_forces import LATER
from pred_core.errors import ConfigError
from pred_core.report import Page, number

CELLS = ("base", "base + network", "extended", "extended + network")
SUMMARY = ("mean", "low", "high")  # [mm], the last two 95 % over episodes
Network = Mapping[str, Mapping[str, Mapping[str, float]]]  # split -> cell -> summary


def read_network(path: Path) -> Network:
    """`network.json` as benchmarks/network_2x2.py writes it. Raises: ConfigError naming what is missing."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return {
            split: {cell: {k: float(values[cell][k]) for k in SUMMARY} for cell in CELLS}
            for split, values in found.items()
        }
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        step = "Make it with benchmarks/network_2x2.py"
        raise ConfigError(f"{path}: cannot be read", got=error, next_step=step) from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{path}: not errors with and without a network",
            got=_lacking(found),
            allowed=f"for each split {', '.join(CELLS)}, each with {', '.join(SUMMARY)} in mm",
            next_step="Make it with benchmarks/network_2x2.py",
        ) from error


def _lacking(found: Any) -> str:
    """The first thing that is wrong with it, in words."""
    if not isinstance(found, dict):
        return f"{type(found).__name__}, not a mapping from splits"
    for split, values in found.items():
        for cell in CELLS:
            row = values.get(cell) if isinstance(values, dict) else None
            if not isinstance(row, dict):
                return f"split '{split}' without '{cell}'"
            for k in SUMMARY:
                if k not in row:
                    return f"'{cell}' of split '{split}' without '{k}'"
                if not isinstance(row[k], (int, float)):
                    return f"{row[k]!r} as '{k}' of '{cell}' of split '{split}'"
    return "something else"


def add_network(page: Page, network: Network | None, guard: Guard | None) -> None:
    """Base and extended, each without and with a network; what the questioned twin's network would hide."""
    page.heading("With and without a network")
    if guard is not None:
        add_guard(page, guard)
    if network is not None:
        rows = [(split, *(_span(cells[c]) for c in CELLS)) for split, cells in network.items()]
        page.table(("episodes", *(f"{c} [mm]" for c in CELLS)), rows)
        page.text("Whole episodes, open loop from two frames; mean distance, held particles included.", note=True)
        return
    page.text(
        "No network is part of this answer: it is trained on the extended twin after the causes are named, so that "
        "it cannot hide them. Base and extended, each with and without one, are compared by:"
    )
    page.code("python benchmarks/network_2x2.py case DATASET --base TWIN --extended DIR/twin --out DIR/network")
    page.code("pred diagnose DATASET --twin TWIN --out DIR --network DIR/network/network.json")


def add_guard(page: Page, guard: Guard) -> None:
    """What of the network's force each family of causes would have made."""
    page.text(f"Of the network that the twin came with: {guard.sentence}.")
    rows, marks = [], []
    for s in guard.families:
        best = max(s.effects, key=lambda i: s.effects[i])
        span = f"{_percent(s.low)} to {_percent(s.high)}"
        rows.append((s.family, _percent(s.share), span, f"{s.p:.2g}", _percent(s.beyond), best))
        marks.append("warn" if s.family in guard.reopened else "")
    header = ("family", "explains alone", "95 % interval", "p adjusted", "beyond all others", "most like it")
    page.table(header, rows, marks)
    page.text(
        f"Share of the variance of what the network does to the positions {LATER:g} s later, {guard.episodes} episodes "
        f"rolled out with it, on recordings the regression did not see ({guard.recordings}). A family above {OPEN:.0%} "
        f"reopens the case: the network does what a cause would do. All families together: {_percent(guard.joint)}.",
        note=True,
    )


def _span(s: Mapping[str, float]) -> str:
    return f"{number(s['mean'])} [{number(s['low'])}, {number(s['high'])}]"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"

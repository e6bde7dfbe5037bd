"""The bench a case was diagnosed on, from what the diagnosis left behind: nothing is fitted again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pred_core.diagnose.commission import commission, with_stored
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Bench
from pred_core.twin import Twin
from pred_core.types import Episode


def pieces(answer: Path) -> dict[str, Any]:
    """Key -> value of the journal in a folder of answers; empty if there is none."""
    journal = answer / "journal.jsonl"
    if not journal.exists():
        return {}
    rows = [json.loads(line) for line in journal.read_text(encoding="utf-8").splitlines()]
    return {r["key"]: r["value"] for r in rows if "key" in r}


def rebuilt(twin: Path, episodes: Sequence[Episode], reference: Sequence[Episode], known: dict[str, Any]) -> Bench:
    """The bench of corrected episodes; the twin is as its refinement on the reference left it, if `known` has that."""
    plain = Twin.load(twin).replace(residual=None)
    journal = Journal(None, {})
    if "base" in known:
        journal.known["base"] = known["base"]
    inner = [[e for e in some if e.split != "ood"] for some in (episodes, reference)]
    return commission(plain, inner[0], inner[1], DiagnoseConfig(), _silent, journal)


def commissioned(twin: Path, answer: Path) -> Twin:
    """What a case was compared with: the twin as its refinement on the reference left it."""
    return with_stored(Twin.load(twin).replace(residual=None), pieces(answer)["base"])


def _silent(text: str) -> None:
    """Nothing is told."""

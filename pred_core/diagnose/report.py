"""The HTML report of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pred_core.diagnose.result import Diagnosis
from pred_core.report.page import Page
from pred_core.types import Episode


def write_report(
    path: Path, answer: Diagnosis, episodes: Sequence[Episode], reference: Sequence[Episode] | None, command: str
) -> None:
    """One file with everything a person wants to see."""
    page = Page("Diagnosis")
    page.text(answer.sentence)
    page.code(command)
    page.write(path)

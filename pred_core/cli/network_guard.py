"""What `pred train` and `pred diagnose` do about a network that would hide a cause."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from pred_core.diagnose.guard import Guard, network_guard
from pred_core.diagnose.report_network import add_guard
from pred_core.errors import PredError
from pred_core.evaluate.report import write_json
from pred_core.report import Page
from pred_core.twin import Twin
from pred_core.types import Episode

FILE = "guard.json"


def question(twin: Twin, episodes: Sequence[Episode], out: Path, dataset: Path, path: Path) -> tuple[Guard, list[str]]:
    """The guard's answer, written to `guard.json` and `guard.html` in `out`, and the lines that tell it.

    `dataset`, `path`: of the data set and the twin, as typed. Raises: PredError where it cannot be asked.
    """
    guard = network_guard(twin, episodes)
    again = "pred " + shlex.join(["diagnose", str(dataset), "--twin", str(path), "--out", "DIR"])
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / FILE, {**guard.to_json(), "reopen_with": again if guard.reopened else None})
    page = Page("Network guard")
    add_guard(page, guard)
    lines = [guard.sentence]
    if guard.reopened:
        lines.append(f"find the cause with: {again}")
        page.code(again)
    page.write(out / "guard.html")
    return guard, lines


def question_or_say(
    twin: Twin, episodes: Sequence[Episode], out: Path, dataset: Path, path: Path, tell: Callable[[str], None]
) -> Guard | None:
    """`question`, told; where it cannot be asked the reason is told, and an older answer in `out` goes."""
    try:
        guard, lines = question(twin, episodes, out, dataset, path)
    except PredError as error:
        for name in (FILE, "guard.html"):
            (out / name).unlink(missing_ok=True)
        tell(f"network guard: not asked: {error}")
        return None
    for line in lines:
        tell(f"network guard: {line}")
    return guard

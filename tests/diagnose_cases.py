"""A small diagnosis: six recordings of a hanging rope, few places and steps."""

from __future__ import annotations

from collections.abc import Sequence

from pred_core.diagnose.commission import commission
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Bench
from pred_core.diagnose.trial import Trial, make_trial
from pred_core.effects import find_effect
from pred_core.twin import Twin
from pred_core.types import Episode

SPLITS = ("train",) * 5 + ("test",)
SMALL = DiagnoseConfig(places=4, survivors=3, iterations=6)


def quiet(_: str) -> None:
    """No progress."""


def bench_of(twin: Twin, suspect: Sequence[Episode], reference: Sequence[Episode]) -> Bench:
    """What a diagnosis of the suspect episodes works on."""
    return commission(twin, suspect, reference, SMALL, quiet, Journal(None, {}))


def drag_trial(bench: Bench) -> Trial:
    """Linear drag as the candidate."""
    return make_trial(bench.twin, (find_effect("drag_linear"),))

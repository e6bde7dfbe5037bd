"""How long the first round will take, said before it begins where that is more than the time it was given."""

from __future__ import annotations

import time

from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.judge import Tell
from pred_core.diagnose.roll import Roller
from pred_core.identify.space import Candidate

SUBSTEPS = 200  # at most, of the rollout that is timed
ROLLOUTS = 2000  # of all windows in a first round, at the substeps of the twin as it is: counted on a case, 2,270


def say_effort(roller: Roller, config: DiagnoseConfig, tell: Tell) -> None:
    """One line if the first round will probably take longer than `config.seconds`; `roller`: of the twin as given."""
    expected, needed = ROLLOUTS * seconds_of(roller), roller.usual()
    if expected <= config.seconds:
        return
    period, stiffness = roller.twin.meta.period, roller.twin.physics.stiffness
    tell(
        f"this will take long: about {duration(expected)} for the first round, which always ends; the twin's stiffness "
        f"of {stiffness:g} N asks for {needed:.0f} substeps in a period of {1e3 * period:.3g} ms, and every rollout "
        f"has {roller.sample.windows.count} windows of {len(roller.sample.windows.target)} periods"
    )


def seconds_of(roller: Roller) -> float:
    """[s] of one rollout of all windows, from one with few substeps: what comes of that does not matter."""
    twin, needed = roller.twin, roller.usual()
    substeps = max(1, min(SUBSTEPS, round(needed)))
    as_it_is = [Candidate(twin.physics, twin.extensions)]
    roller.errors(as_it_is, substeps=1)  # the first call may compile
    begin = time.monotonic()
    roller.errors(as_it_is, substeps=substeps)
    return (time.monotonic() - begin) * needed / substeps


def duration(seconds: float) -> str:
    """In the unit a person would say: "40 s", "12 min", "3.4 h"."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"

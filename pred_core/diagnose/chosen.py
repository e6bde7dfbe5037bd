"""Which candidate of a round became a name."""

from __future__ import annotations

from collections.abc import Sequence

from pred_core.diagnose.evidence import Judged
from pred_core.diagnose.progress import Round
from pred_core.diagnose.result import Cause


def chosen_of(rounds: Sequence[Round], causes: Sequence[Cause]) -> list[Judged | None]:
    """For each round the candidate that was named in it. `causes`: of the answer, in the order they were named; those
    that no round tried (the gate's, another structure) are left out.
    """
    tried = {i for seen in rounds for j, _, _ in seen.judged for i in j.trial.ids}
    left = [c.id for c in causes if not c.measured and c.id in tried]
    found: list[Judged | None] = []
    for seen in rounds:
        fits = [j for j, _, why in seen.judged if not why and list(j.trial.ids) == left[: len(j.trial.ids)]]
        best = max(fits, key=lambda j: len(j.trial.ids), default=None)
        left = left[len(best.trial.ids) :] if best else left
        found.append(best)
    return found

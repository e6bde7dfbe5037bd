"""Probabilities and the ranking, from the gains on held-out episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pred_core.diagnose.evidence import rivals
from pred_core.diagnose.result import Ranked
from pred_core.diagnose.rounds import Named, Round

SHARP = 1.0  # how fast a rival's weight falls with the standard errors it is behind
COLD = 0.8  # without a reference: what engine and object lack in common can look like a cause
UNSEEN = 0.05  # probability left for "unknown" where nothing is seen, and for "none" where something is
EXPLAINS = (0.45, 8.0)  # share of the excess closed at which "it explains it" is even, and how steeply that rises


def explains(closed: float) -> float:
    """Probability that a cause that closes this share of the excess is not a stand-in for something unknown."""
    middle, slope = EXPLAINS
    return 1.0 / (1.0 + math.exp(-slope * (min(closed, 1.2) - middle)))


def confidence(named: Named, floor: bool) -> float:
    """Probability that a name stands for what is there. Without a floor nobody knows how much there is to explain."""
    return (explains(named.closed) if floor else COLD) * (1.0 - min(named.p_adjusted, 1.0))


def ranking(rounds: Sequence[Round], named: Sequence[Named], unknown: bool) -> list[Ranked]:
    """All candidates of the first round, then "unknown" and "none". `unknown`: something is left without a name."""
    if not rounds or not rounds[0].judged:
        return [Ranked("none", "none", 1.0, 0.0, 1.0, "")]
    first = rounds[0]
    excess = max(float(first.base.mean()) - first.floor, 1e-9)
    judged = [j for j, _, _ in first.judged]
    chosen = next((n for n in named if n.round == 0), None)
    best = chosen.judged if chosen else max(judged, key=lambda j: j.mean)
    weight = {j.trial.id: math.exp(-SHARP * max(z, 0.0)) for j, z in rivals(judged, best)}
    p = {j.trial.id: (q, why) for j, q, why in first.judged}
    allowed = {k: w for k, w in weight.items() if not p[k][1] or (chosen is not None and k == best.trial.id)}
    total = sum(allowed.values()) or 1.0
    sure = 0.0 if chosen is None else confidence(chosen, rounds[0].floor > 0.0)
    rows = [
        Ranked(
            id=j.trial.id,
            family=j.trial.family,
            probability=sure * allowed.get(j.trial.id, 0.0) / total,
            gain=j.mean / excess,
            p_adjusted=p[j.trial.id][0],
            rejected=_why(j.trial.id, p[j.trial.id][1], chosen, best.trial.id),
            values=j.values,
        )
        for j in judged
    ]
    rows.sort(key=lambda r: (-r.probability, -r.gain))
    none = 0.0 if chosen is not None else UNSEEN if unknown else 1.0 - UNSEEN
    rest = max(0.0, 1.0 - sure - none)
    return [*rows, Ranked("unknown", "unknown", rest, 0.0, 1.0, ""), Ranked("none", "none", none, 0.0, 1.0, "")]


def _why(id: str, why: str, chosen: Named | None, best: str) -> str:
    if why or chosen is None or id == best:
        return why
    return f"these data do not tell it apart from {best}" if id in chosen.group else f"saves less than {best}"

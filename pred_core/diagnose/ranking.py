"""Probabilities and the ranking, from the gains on held-out episodes."""

from __future__ import annotations

import dataclasses
import math

from pred_core.diagnose.evidence import elsewhere, rivals
from pred_core.diagnose.gate import GateResult
from pred_core.diagnose.progress import Named, Progress, Round
from pred_core.diagnose.result import Ranked

SHARP = 1.0  # how fast a rival's weight falls with the standard errors it is behind
OCCAM = 0.5  # weight of a rival for each parameter that it has beyond the best one's
COLD = 0.8  # without a reference: what engine and object lack in common can look like a cause
UNSEEN = 0.05  # probability left for "none" where no candidate explains what is seen, and for a law the data contradict
FOUND = 0.88, 0.05  # share of hidden effects (75 of 85 seen cases) that give a family-wise p below this
EVEN, STEEP = 0.45, 8.0  # share of the excess closed at which "it explains it" is even, and how steeply that rises


def explains(closed: float) -> float:
    """Probability that a cause that closes this share of the excess is not a stand-in for something unknown."""
    return 1.0 / (1.0 + math.exp(-STEEP * (min(closed, 1.0) - EVEN)))


def nothing(p: float) -> float:
    """Probability that nothing is there, from the least family-wise p of a round in which nothing was named, or from
    that of a cause which the gate found.

    Even odds before; p is uniform where nothing is there, and distributed as p^a where something is (Beta(a, 1);
    Sellke, Bayarri and Berger, The American Statistician 55, 2001), a from how often effects are found.
    """
    share, level = FOUND
    a = math.log(share) / math.log(level)
    density: float = a * max(p, 1e-6) ** (a - 1.0)
    return 1.0 / (1.0 + density)


def confidence(named: Named, floor: bool) -> float:
    """Probability that a name stands for what is there. Without a floor nobody knows how much there is to explain."""
    if named.contradicted:
        return UNSEEN
    return explains(named.closed) if floor else COLD


def ranking(gate: GateResult, progress: Progress) -> list[Ranked]:
    """What was named, the finalists of the first round, "unknown" and "none".

    Several causes can be there at once. So those named before or after the first round, by the gate or by a later one,
    have each a probability of their own. The first round's candidates and "unknown" (it has no name, or another one)
    answer what the simulation lacks besides: what they leave of 1 is that it lacks nothing more. "none" has that where
    nothing was named before, and 0 once anything was.
    """
    floor = progress.bench.reference is not None
    before = [
        Ranked(c.id, "", 1.0 - nothing(c.p_adjusted), 0.0, c.p_adjusted, "")
        for c in gate.accepted
        if c.id in gate.sensor_ids
    ]
    before += [_row(n, confidence(n, floor)) for n in progress.named if n.round < 0]
    later = [_row(n, confidence(n, floor)) for n in progress.named if n.round > 0]
    first = _first_round(progress, floor)
    if before:
        first = [dataclasses.replace(r, probability=0.0) if r.id == "none" else r for r in first]
    seen = {r.id for r in (*before, *later)}
    return sorted((*before, *later, *(r for r in first if r.id not in seen)), key=lambda r: (-r.probability, -r.gain))


def _row(n: Named, probability: float) -> Ranked:
    return Ranked(n.judged.trial.id, n.judged.trial.family, probability, n.closed, n.p_adjusted, "", n.judged.values)


def _first_round(progress: Progress, floor: bool) -> list[Ranked]:
    chosen = next((n for n in progress.named if n.round == 0), None)
    judged = progress.rounds[0].judged if progress.rounds else ()
    least = min((p for _, p, _ in judged), default=1.0)
    none = 0.0 if chosen is not None else UNSEEN if progress.unknown else nothing(least)
    sure = 0.0 if chosen is None else confidence(chosen, floor)
    end = [
        Ranked("unknown", "unknown", max(0.0, 1.0 - sure - none), 0.0, 1.0, ""),
        Ranked("none", "none", none, 0.0, 1.0, ""),
    ]
    if not judged:
        return end
    return [*_finalists(progress.rounds[0], chosen, sure), *end]


def _finalists(first: Round, chosen: Named | None, sure: float) -> list[Ranked]:
    whole = float(first.base.mean())
    excess = max(whole - first.floor, 0.05 * whole, 1e-9)
    judged = [j for j, _, _ in first.judged]
    best = chosen.judged if chosen else min(judged, key=lambda j: j.left)
    apart = {j.trial.id for j in judged if elsewhere(j, best)}
    weight = {
        j.trial.id: math.exp(-SHARP * max(z, 0.0)) * OCCAM ** max(j.parameters - best.parameters, 0)
        for j, z in rivals(judged, best)
        if j.trial.id not in apart
    }
    p = {j.trial.id: (q, why) for j, q, why in first.judged}
    allowed = {k: w for k, w in weight.items() if not p[k][1] or (chosen is not None and k == best.trial.id)}
    total = sum(allowed.values()) or 1.0
    return [
        Ranked(
            id=j.trial.id,
            family=j.trial.family,
            probability=sure * allowed.get(j.trial.id, 0.0) / total,
            gain=j.mean / excess,
            p_adjusted=p[j.trial.id][0],
            rejected=_why(j.trial.id, p[j.trial.id][1], chosen, j.trial.id in apart),
            values=j.values,
        )
        for j in judged
    ]


def _why(id: str, why: str, chosen: Named | None, apart: bool) -> str:
    if why or chosen is None or id == chosen.judged.trial.id:
        return why
    best = chosen.judged.trial.id
    if apart:
        return f"saves in other episodes than {best}: a cause besides it, if it is one"
    return f"these data do not tell it apart from {best}" if id in chosen.group else f"saves less than {best}"

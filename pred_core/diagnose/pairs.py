"""Two causes at once: they can mask each other."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from pred_core.diagnose.evidence import Judged, family_wise
from pred_core.diagnose.judge import Effects, Screened, Tell, judge
from pred_core.diagnose.naming import LEFT, share_closed, why_not
from pred_core.diagnose.places import Start
from pred_core.diagnose.progress import Named, Progress
from pred_core.types import Array

PAIRED = 5  # candidates whose pairs are tried


def try_pairs(
    progress: Progress,
    kept: Sequence[Screened],
    judged: Sequence[Judged],
    base: Array,
    floor: float,
    tell: Tell,
    number: int,
) -> Named | None:
    """Two causes at once, where no single one explains enough: they can mask each other."""
    bench, config = progress.bench, progress.bench.config
    excess = float(base.mean()) - floor
    if bench.reference is None:  # without a floor nobody knows how much is enough
        return None
    if excess < LEFT * floor or sum(len(n.judged.trial.ids) for n in progress.named) + 2 > config.causes:
        return None
    order = sorted(range(len(judged)), key=lambda n: -judged[n].mean)[:PAIRED]
    best: Judged | None = None
    alone = max(j.mean for j in judged)
    tried: list[Judged] = []
    for a, b in itertools.combinations(order, 2):
        if judged[a].trial.family == judged[b].trial.family:
            continue
        if judged[a].mean + judged[b].mean < 0.6 * excess:
            continue
        if progress.overdue():
            break
        effects: Effects = (*kept[a].effects, *kept[b].effects)
        trial = bench.trial(effects)
        begin = trial.space.start()
        values = {**judged[a].values, **judged[b].values}
        for n, k in enumerate(trial.space.knobs):
            if k.name in values:
                begin[n] = k.coordinate(values[k.name])
        screened = Screened(effects, trial, [Start(begin, 0.0)], 0.0, trial.space.start())
        both = judge(bench, screened, progress.journal, f"{number}/pair/{trial.id}")
        tell(f"round {number + 1}: pair {both.trial.id}: gain {both.mean:.3f}")
        tried.append(both)
        if best is None or both.mean > best.mean:
            best = both
    if best is None or best.mean < max(config.enough * excess, alone + 0.15 * excess):
        return None
    groups = bench.target.roller.sample.groups
    p = float(family_wise(tried, config.seed, groups)[[t is best for t in tried].index(True)])
    if why_not(best, p, excess, floor, progress) or not all(best.is_on(id) for id in best.trial.ids):
        return None
    return Named(best, p, (), share_closed(best, excess, floor), number)

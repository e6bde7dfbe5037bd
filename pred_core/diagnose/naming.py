"""Which candidate of a round gets a name, and why the others do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pred_core.diagnose.evidence import (
    FEWEST_ACTING,
    FEWEST_GROUPS,
    Judged,
    elsewhere,
    family_wise,
    rivals,
    set_limit,
    simplest,
)
from pred_core.diagnose.judge import Bench
from pred_core.diagnose.progress import Named, Progress

LEFT = 0.25  # of the floor: an excess that is called unknown if nothing explains it
FEWEST = 10  # episodes for inference; fewer are exploratory
HALF = 0.5  # of the least gain: a cause must save so much beside "off" too, whatever the reference says of it
EXPLORATORY = 0.5  # share of the excess a cause must close to be named from fewer
BETTER = 0.1  # of the gain of a simpler law that one with more parameters must save beyond it to be its rival
STANDING = 0.1  # of the floor: a gain below is not worth a name, whatever its significance: bases differ by 0.07


def exploratory(bench: Bench) -> bool:
    """These data allow no inference."""
    return bench.target.roller.sample.episodes < FEWEST or bool(one_recording(bench))


def one_recording(bench: Bench) -> str:
    """What to do about train episodes that are all of one recording; "" if they are not."""
    if len(set(bench.target.roller.sample.groups[bench.train].tolist())) > 1:
        return ""
    return (
        f"all train episodes ({int(bench.train.sum())}) are of one recording: exploratory, because no parameter was "
        "fitted without the recording it is judged on, so there is neither an interval nor a cross-fit; record two or "
        f"more, better {FEWEST_GROUPS}, each begun anew, and give each its number under 'recording' in dataset.yaml"
    )


def choose(
    judged: Sequence[Judged], excess: float, floor: float, progress: Progress
) -> tuple[Named | None, list[tuple[Judged, float, str]]]:
    """(the name, or None; every candidate with its adjusted p value and why it is not named, largest gain first)."""
    config = progress.bench.config
    p = family_wise(judged, config.seed, progress.bench.target.roller.sample.groups)
    rows = [(j, float(q), why_not(j, float(q), excess, floor, progress)) for j, q in zip(judged, p, strict=True)]
    rows.sort(key=lambda row: -row[0].mean)
    accepted = [row for row in rows if not row[2]]
    if not accepted:
        return None, rows
    best = min(accepted, key=lambda row: row[0].left)[0]
    chosen = simplest([row[0] for row in accepted], best)
    limit = set_limit(len(chosen.gain))
    near = [
        o
        for o, z in rivals([r[0] for r in accepted], chosen)
        if o is not chosen
        and z < limit
        and not elsewhere(o, chosen)
        and not (o.parameters > chosen.parameters and not much_better(o, chosen))
    ]
    q = next(row[1] for row in accepted if row[0] is chosen)
    closed = share_closed(chosen, excess, floor)
    return Named(chosen, q, tuple(o.trial.id for o in near), closed, len(progress.rounds)), rows


def much_better(one: Judged, simpler: Judged) -> bool:
    """Whether a candidate with more parameters saves so much more that a simpler law does not replace it."""
    return simpler.left - one.left >= BETTER * simpler.mean


def why_not(j: Judged, p: float, excess: float, floor: float, progress: Progress) -> str:
    """Why a candidate is not named; "" if it may be. `excess` of the base's loss over `floor`, below 0 if under it."""
    config = progress.bench.config
    cold = progress.bench.reference is None
    without = floor + excess
    whole = max(excess, 0.0) if not progress.rounds or cold else max(progress.whole(), excess, 0.0)
    least = max((config.cold_gate if cold and progress.well else config.gate) * whole, STANDING * floor)
    if without - j.left < HALF * least:  # what it saves beside the reference's value is not saved beside "off"
        return f"leaves {j.left:.3f} of the loss, where {without:.3f} are left without it"
    acting = int(j.acts.sum())
    if exploratory(progress.bench):  # no inference: what helps everywhere, and much, is named as exploratory
        if acting == 0:
            return _idle(j)
        if j.worse:
            return f"{j.worse} of {acting} episodes get worse"
        if whole <= 0.0:
            return "there is no more error than in the reference"
        return "" if j.mean >= max(EXPLORATORY * whole, least) else f"saves too little ({j.mean:.3f} of the loss)"
    if acting < FEWEST_ACTING:
        return _idle(j)
    if p > config.level:
        return f"not significant (adjusted p {p:.3f})"
    if j.mean < least:
        return f"saves too little ({j.mean:.3f} of the loss, {least:.3f} needed)"
    if j.worse > (1.0 - config.improved) * acting:
        return f"{j.worse} of {acting} episodes get worse"
    if not j.excludes_null:
        return "its interval includes no change"
    return ""


def _idle(j: Judged) -> str:
    acts = f"acts in {int(j.acts.sum())} episodes only"
    return f"fitted to no change: it {acts}, though these motions excite it" if j.excites else acts


def share_closed(j: Judged, excess: float, floor: float) -> float:
    """Share of the round's excess that is gone with it, 0 to 1; all of it where motions are so easy that there is none:
    a named cause then leaves less than what is usual on the reference.
    """
    if excess <= 0.0:
        return 1.0
    standing = excess + floor
    return float(np.clip((standing - float(j.extended.mean())) / excess, 0.0, 1.0))

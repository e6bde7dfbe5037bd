"""One cause after the other: screen, fit, judge, name, extend, and look again at what is left."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pred_core.diagnose.commission import with_values
from pred_core.diagnose.evidence import Judged, family_wise, lack_of_fit, rivals, set_limit, simplest
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import QUICK, Bench, Effects, Screened, Tell, judge, quick, rng_of, screen
from pred_core.diagnose.roll import on_ground
from pred_core.diagnose.search import Start
from pred_core.diagnose.skill import POOR, skill_of
from pred_core.diagnose.trial import NOT_A_NAME, make_trial
from pred_core.effects import LIBRARY
from pred_core.twin import Twin
from pred_core.types import Array

GATE_ONLY = ("gripper_offset", "gripper_rotation")  # absorbed by measured starts: the model-free gate names them
WORTH = 0.02  # of the floor: what a candidate must promise to be fitted to the end
LEFT = 0.25  # of the floor: an excess that is called unknown if nothing explains it
SURE = 0.01  # p value of a lack of fit
FEW, FINALISTS = 2, 5  # candidates that are fitted to the end: at least, and at most
BEHIND = 0.35  # share of the leader's gain below which the others are not
UNEXPLAINED = 3.0  # times the loss of noise: without a reference, what is left is then worth saying
NOISE = 0.4  # loss of residuals that are noise: the mean of rho(u) for u ~ N(0, 1) is 0.36
FEWEST = 10  # episodes for inference; fewer are exploratory
SLIGHT = 0.05  # of the mean gain: an episode that loses less is not worse
EXPLORATORY = 0.5  # share of the excess a cause must close to be named from fewer
CLOSE = 0.6  # share of the promise of its family's leader from which a candidate is kept beside it
BETTER = 1.1  # times the gain of a simpler law that one with more parameters needs to be its rival
PAIRED = 5  # candidates whose pairs are tried
STANDING = 0.05  # of the floor: a gain below is not worth a name, whatever its significance


@dataclass(frozen=True)
class Named:
    """A cause that was accepted."""

    judged: Judged
    p_adjusted: float
    group: tuple[str, ...]  # others that these data do not tell apart from it
    closed: float  # share of the excess of its round that it closes
    round: int


@dataclass(frozen=True)
class Round:
    """What a round saw."""

    base: Array  # (E,) losses before it
    floor: float  # mean loss of the reference, or nothing
    screened: tuple[tuple[str, float], ...]  # candidate, promise
    judged: tuple[tuple[Judged, float, str], ...]  # candidate, adjusted p, why it was rejected ("" = accepted)


@dataclass
class Progress:
    """State of a diagnosis between rounds."""

    bench: Bench
    journal: Journal
    twins: list[Twin]  # before anything was named, and after each name
    deadline: float = math.inf  # [s] of `time.monotonic`
    named: list[Named] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    unknown: bool = False
    unknown_p: float = 1.0
    explained: float | None = None  # share of the motion, in the end; None: the object hardly moves
    notes: list[str] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)  # effect -> why it cannot be tried

    def add(self, named: Named, bench: Bench) -> None:
        """Take a name, and the bench that has it."""
        self.named = [_refitted(n, named.judged) for n in self.named]
        self.named.append(named)
        self.bench = bench
        self.twins.append(bench.twin)

    def late(self) -> bool:
        """Whether the time is used up."""
        return time.monotonic() > self.deadline


def _refitted(named: Named, later: Judged) -> Named:
    """An earlier name with the values it has beside a later one: they were fitted together."""
    j = named.judged
    mine = set(j.values) & set(later.values)
    judged = dataclasses.replace(
        j,
        values={**j.values, **{k: later.values[k] for k in mine}},
        intervals={**j.intervals, **{k: later.intervals[k] for k in mine}},
    )
    return dataclasses.replace(named, judged=judged)


def candidates(bench: Bench, named: Sequence[str]) -> list[Effects]:
    """Effects worth trying on this bench: those that can act and are not named yet."""
    twin = bench.twin
    cold = bench.reference is None
    rows: list[Effects] = []
    for effect in LIBRARY.values():
        if set(effect.hooks) == {"observe"} or effect.id in GATE_ONLY or effect.id in named:
            continue
        if effect.id in NOT_A_NAME and not (cold and effect.id == "rest_curvature"):
            continue
        if "contact" in effect.hooks and twin.scene.ground is None:
            continue
        if {"bend", "bend_stiffness"} & set(effect.hooks) and not (
            len(twin.body.bends) and twin.physics.bending_stiffness > 0.0
        ):
            continue
        if cold and effect.id in _SAME_AS_BASE:
            continue
        rows.append((effect,))
    return rows


_SAME_AS_BASE = ("friction_scale", "bending_scale", "stretch_scale")


def one_round(progress: Progress, tell: Tell, number: int) -> bool:
    """Look for one more cause. Returns whether something was named."""
    bench, config = progress.bench, progress.bench.config
    base = bench.standing()
    floor = float(_reference_losses(bench).mean()) if bench.reference is not None else 0.0
    if number and not _something_left(progress, base, floor):
        return False
    named = [i for n in progress.named for i in n.judged.trial.ids]
    options = candidates(bench, named)
    screened = []
    for n, effects in enumerate(options):
        key = f"{number}/screen/{'+'.join(e.id for e in effects)}"
        screened.append(screen(bench, effects, rng_of(config.seed, key), progress.journal, key))
        if n % 8 == 0:
            tell(f"round {number + 1}: screening {n}/{len(options)}")
    screened.sort(key=lambda s: -s.promise)
    tell("round {}: most promising: {}".format(number + 1, ", ".join(s.trial.id for s in screened[:4])))
    worth = WORTH * (floor or float(base.mean()))
    kept = _survivors(screened, config.survivors, worth)
    finalists = _halve(progress, kept, worth, tell, number)
    judged: list[Judged] = []
    for n, s in enumerate(finalists):
        judged.append(judge(bench, s, progress.journal, f"{number}/fit/{s.trial.id}"))
        gain = f"gain {judged[-1].mean:.3f} of {base.mean():.3f}"
        tell(f"round {number + 1}: fitted {n + 1}/{len(finalists)}, {s.trial.id}: {gain}")
    kept = finalists
    excess = max(float(base.mean()) - floor, 0.0)
    found, rows = _choose(judged, excess, floor, progress, tell)
    closed = found.closed if found else 0.0
    if (found is None or closed < config.enough) and not progress.late():
        pair = _pairs(progress, kept, judged, base, floor, tell, number)
        if pair is not None:
            found = pair
            rows = [*rows, (pair.judged, pair.p_adjusted, "")]
    progress.rounds.append(
        Round(base, floor, tuple((s.trial.id, s.promise) for s in screened), tuple(rows))
    )
    if found is None:
        return False
    progress.add(found, extend(bench, found.judged))
    return True


def _something_left(progress: Progress, base: Array, floor: float) -> bool:
    """Whether what is left after a name is worth another look."""
    first = progress.rounds[0]
    whole = float(first.base.mean()) - first.floor
    if progress.bench.reference is None:
        return float(base.mean()) > NOISE
    return float(base.mean()) - floor > max(progress.bench.config.gate * whole, STANDING * floor)


def finish(progress: Progress) -> None:
    """Decide whether something is left that has no name."""
    bench = progress.bench
    found = skill_of(bench.twin, bench.target.roller, bench.config.stride)
    progress.explained = None if found is None else found.share
    poor = found is not None and found.share < POOR
    if bench.reference is None:
        loud = not progress.named and float(bench.standing().mean()) > UNEXPLAINED * NOISE
        progress.unknown = loud or poor
        return
    suspect, reference = bench.standing(), _reference_losses(bench)
    if min(len(suspect), len(reference)) < FEWEST:
        loud = float(suspect.mean()) > UNEXPLAINED * float(reference.mean())
        progress.unknown = not progress.named and (loud or poor)
        return
    p = lack_of_fit(
        suspect, reference, bench.config.seed, on_ground(bench.target.roller), on_ground(bench.reference.roller)
    )
    progress.unknown_p = p
    lacking = p < SURE and float(suspect.mean()) > (1.0 + LEFT) * float(reference.mean())
    progress.unknown = lacking or (poor and not progress.named)


def extend(bench: Bench, judged: Judged) -> Bench:
    """Both twins with the cause in it: the suspect's as fitted, the reference's as it is without the change."""
    space = judged.trial.space
    null = np.array([k.coordinate(judged.null[k.name]) for k in space.knobs])
    twin = with_values(bench.twin, space.candidate(judged.z))
    changed = {e.id: e for e in space.candidate(null).extensions if e.id in judged.trial.ids}
    kept = tuple(changed.pop(e.id, e) for e in bench.reference_twin.extensions) + tuple(changed.values())
    reference = bench.reference_twin.replace(extensions=kept)
    free = (*bench.free, *judged.trial.ids)
    return dataclasses.replace(bench, twin=twin, reference_twin=reference, free=free)


def _reference_losses(bench: Bench) -> Array:
    assert bench.reference is not None
    space = make_trial(bench.reference_twin, (), ()).space
    return bench.reference.losses(space, [space.start()])[0]


def _survivors(screened: list[Screened], count: int, least: float) -> list[Screened]:
    """The most promising ones, the best of every family that promises anything, and who is close to it."""
    leader: dict[str, float] = {}
    for s in screened:
        leader.setdefault(s.trial.family, s.promise)
    kept = [
        s
        for n, s in enumerate(screened)
        if s.promise > least and (n < count or s.promise >= CLOSE * leader[s.trial.family])
    ]
    return kept or screened[:2]


def _halve(
    progress: Progress, kept: Sequence[Screened], worth: float, tell: Tell, number: int
) -> list[Screened]:
    """The candidates that lead after a few steps: a straight line promises little of a localized cause."""
    bench = progress.bench
    before = float(bench.standing()[bench.train].mean())
    rows = []
    for s in kept:
        z, loss = quick(bench, s, progress.journal, f"{number}/quick/{s.trial.id}")
        rows.append((before - loss, dataclasses.replace(s, starts=[Start(z, before - loss)])))
    rows.sort(key=lambda row: -row[0])
    tell(f"round {number + 1}: ahead after {QUICK} steps: " + ", ".join(r[1].trial.id for r in rows[:4]))
    least = max(BEHIND * rows[0][0], worth)
    return [s for n, (saved, s) in enumerate(rows) if n < FEW or (n < FINALISTS and saved >= least)]


def _choose(
    judged: Sequence[Judged], excess: float, floor: float, progress: Progress, tell: Tell
) -> tuple[Named | None, list[tuple[Judged, float, str]]]:
    config = progress.bench.config
    p = family_wise(judged, config.seed, progress.bench.target.roller.sample.groups)
    rows = [(j, float(q), _why_not(j, float(q), excess, floor, progress)) for j, q in zip(judged, p, strict=True)]
    rows.sort(key=lambda row: -row[0].mean)
    accepted = [row for row in rows if not row[2]]
    if not accepted:
        return None, rows
    best = max(accepted, key=lambda row: row[0].mean)[0]
    chosen = simplest([row[0] for row in accepted], best)
    limit = set_limit(len(chosen.gain))
    near = [
        o
        for o, z in rivals([r[0] for r in accepted], chosen)
        if o is not chosen and z < limit and not (o.parameters > chosen.parameters and o.mean < BETTER * chosen.mean)
    ]
    q = next(row[1] for row in accepted if row[0] is chosen)
    closed = share_closed(chosen, progress, excess, floor)
    return Named(chosen, q, tuple(o.trial.id for o in near), closed, len(progress.rounds)), rows


def _why_not(j: Judged, p: float, excess: float, floor: float, progress: Progress) -> str:
    config = progress.bench.config
    cold = progress.bench.reference is None
    first = progress.rounds[0] if progress.rounds else None
    whole = excess if first is None or cold else max(float(first.base.mean()) - first.floor, excess)
    least = max((config.cold_gate if cold else config.gate) * whole, STANDING * floor)
    better, acting = j.improved
    if len(j.gain) < FEWEST:  # no inference from so few: what helps everywhere, and much, is named as exploratory
        worse = int((j.gain[j.acts] < -SLIGHT * j.mean).sum())
        if acting == 0 or worse:
            return f"{worse} of {acting} episodes get worse"
        return "" if j.mean >= max(EXPLORATORY * whole, least) else f"saves too little ({j.mean:.3f} of the loss)"
    if acting < 4:
        return f"acts in {acting} episodes only"
    if p > config.level:
        return f"not significant (adjusted p {p:.3f})"
    if j.mean < least:
        return f"saves too little ({j.mean:.3f} of the loss, {least:.3f} needed)"
    if better < config.improved * acting:
        return f"{better} of {acting} episodes improve"
    if not j.excludes_null:
        return "its interval includes no change"
    return ""


def share_closed(j: Judged, progress: Progress, excess: float, floor: float) -> float:
    """Share of the round's excess that is gone with it, 0 to 1."""
    if excess <= 0.0:
        return 0.0
    standing = excess + floor
    return float(np.clip((standing - float(j.extended.mean())) / excess, 0.0, 1.0))


def _every_member(j: Judged) -> bool:
    """Whether each effect of a pair has a switch whose interval leaves out its null."""
    for id in j.trial.ids:
        knobs = [j.trial.space.knobs[n].name for n in j.trial.amplitudes]
        mine = [k for k in knobs if k.startswith(f"{id}.")]
        if not any(j.intervals[k][0] > j.null[k] or j.intervals[k][1] < j.null[k] for k in mine):
            return False
    return True


def _pairs(
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
    if _why_not(best, p, excess, floor, progress) or not _every_member(best):
        return None
    return Named(best, p, (), share_closed(best, progress, excess, floor), number)

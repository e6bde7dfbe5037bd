"""One cause after the other: screen, fit, judge, name, extend, and look again at what is left."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import numpy as np

from pred_core.diagnose.commission import with_values
from pred_core.diagnose.evidence import ACTS, Judged, lack_of_fit
from pred_core.diagnose.fit import IN_FULL, counted
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import (
    QUICK,
    Bench,
    Effects,
    Screened,
    Tell,
    excitation,
    judge,
    quick,
    rng_of,
    scaled,
    screen,
    standing_of,
)
from pred_core.diagnose.naming import FEWEST, LEFT, STANDING, choose
from pred_core.diagnose.pace import Pace
from pred_core.diagnose.pairs import try_pairs
from pred_core.diagnose.places import Start
from pred_core.diagnose.progress import Progress, Round
from pred_core.diagnose.roll import on_ground
from pred_core.diagnose.skill import POOR, WELL, skill_of
from pred_core.diagnose.trial import NOT_A_NAME, scanned
from pred_core.effects import LIBRARY
from pred_core.effects.effect import Effect
from pred_core.twin import Twin
from pred_core.types import Array

GATE_ONLY = ("gripper_offset", "gripper_rotation")  # taken in by measured starts; the gate names the first
WORTH = 0.03  # of the floor: what a candidate must promise to be fitted to the end
SURE = 0.02  # p value of a lack of fit
FEW, FINALISTS = 2, 5  # candidates that are fitted to the end: at least, and at most
BEHIND = 0.35  # share of the leader's gain below which the others are not
TOLD = 4  # candidates between two lines
QUIET = 15.0  # [s] without a line, at most by one candidate
NOISE = 0.4  # loss of residuals that are noise: the mean of rho(u) for u ~ N(0, 1) is 0.36
UNEXPLAINED = 1.2  # loss beyond which, without a reference, what is left is worth saying
USUALLY = 3.0  # times the reference's loss: the same where there are too few episodes for a test
SAME_AS_BASE = ("friction_scale", "bending_scale", "stretch_scale")  # of what is refitted without a reference
CLOSE = 0.6  # share of the promise of its family's leader from which a candidate is kept beside it


def candidates(bench: Bench, named: Sequence[str]) -> tuple[list[Effects], dict[str, str]]:
    """Effects worth trying on this bench, those that can act and are not named yet; candidate -> why it cannot."""
    cold = bench.reference is None
    rows: list[Effects] = []
    passed = {"gripper_rotation": "starts are measured: what a turned gripper frame does to them is taken in"}
    for effect in LIBRARY.values():
        if set(effect.hooks) == {"observe"} or effect.id in GATE_ONLY or effect.id in named:
            continue
        if effect.id in NOT_A_NAME and not (cold and effect.id == "rest_curvature"):
            continue
        why = _cannot_act(effect, bench.twin)
        if not why and cold and effect.id in SAME_AS_BASE:
            why = "a number of the twin itself, which is refined first where there is no reference"
        if why:
            passed[effect.id] = why
        else:
            rows.append((effect,))
    return rows, passed


def _cannot_act(effect: type[Effect], twin: Twin) -> str:
    """Why an effect does nothing in this twin, whatever its size; "" if it may."""
    if "contact" in effect.hooks and twin.scene.ground is None:
        return "the twin's scene has no table"
    bends = len(twin.body.bends) and twin.physics.bending_stiffness > 0.0
    return "" if bends or not {"bend", "bend_stiffness"} & set(effect.hooks) else "the twin does not bend by angles"


def excited(bench: Bench, screened: Sequence[Screened], journal: Journal, key: str) -> dict[str, int]:
    """Candidate -> episodes that a typical change of it would move; not those that act in a place, wherever that is,
    except on a table that nothing touches."""

    def find() -> dict[str, int]:
        found = {}
        touched = int(on_ground(bench.target.roller).sum())
        for s in screened:
            off = s.trial.space.start()
            if not any(scanned(e) for e in s.effects):
                found[s.trial.id] = int((excitation(bench.target, s.trial, off, off) > ACTS).sum())
            elif any("contact" in e.hooks for e in s.effects) and not touched:
                found[s.trial.id] = 0
        return found

    return journal.piece(key, find, lambda v: {str(k): int(n) for k, n in v.items()})


def one_round(progress: Progress, tell: Tell, number: int) -> bool:
    """Look for one more cause. Returns whether something was named."""
    bench, config = progress.bench, progress.bench.config
    base, floor = bench.standing(), _floor(bench)
    progress.well = explains_well(bench)
    named = [i for n in progress.named for i in n.judged.trial.ids]
    options, passed = candidates(bench, named)
    screened, told = [], time.monotonic()
    pace = Pace(len(options), progress.journal)
    for n, effects in enumerate(options):
        progress.go_on(number)
        key = f"{number}/screen/{'+'.join(e.id for e in effects)}"
        screened.append(screen(bench, effects, rng_of(config.seed, key), progress.journal, key))
        if n % 8 == 0 or time.monotonic() - told > QUIET:
            told = time.monotonic()
            left = pace.left(n + 1) if n else ""  # the first ones are the cheapest
            tell(f"round {number + 1}: screening {n + 1}/{len(options)}{left}")
    screened.sort(key=lambda s: -s.promise)
    tell("round {}: most promising: {}".format(number + 1, ", ".join(s.trial.id for s in screened[:4])))
    worth = WORTH * (floor or float(base.mean()))
    kept = _survivors(screened, config.survivors, worth)
    finalists = _halve(progress, kept, worth, tell, number)
    judged: list[Judged] = []
    pace = Pace(len(finalists), progress.journal)
    for n, s in enumerate(finalists):
        progress.go_on(number)
        judged.append(judge(bench, s, progress.journal, f"{number}/fit/{s.trial.id}"))
        gain = f"gain {judged[-1].mean:.3f} of {base.mean():.3f}"
        tell(f"round {number + 1}: fitted {n + 1}/{len(finalists)}, {s.trial.id}: {gain}{pace.left(n + 1)}")
    excess = float(base.mean()) - floor
    found, rows = choose(judged, excess, floor, progress)
    closed = found.closed if found else 0.0
    if (found is None or closed < config.enough) and not progress.late():
        pair = try_pairs(progress, finalists, judged, base, floor, tell, number)
        if pair is not None:
            found = pair
            rows = [*rows, (pair.judged, pair.p_adjusted, "")]
    rest = [s for s in screened if s.trial.id not in {f.trial.id for f in finalists}]
    acting = {} if progress.rounds else excited(bench, rest, progress.journal, f"{number}/excited")
    screens = tuple((s.trial.id, s.promise) for s in screened)
    progress.rounds.append(Round(base, floor, screens, tuple(rows), acting, passed))
    if found is None:
        return False
    progress.add(found, extend(bench, found.judged))
    return True


def explains_well(bench: Bench) -> bool:
    """Whether the twin explains the motion as far as is usual where nothing is hidden; a cause must then save more."""
    found = skill_of(bench.twin, bench.target.roller, bench.config.stride)
    return found is None or found.share >= WELL


def something_left(progress: Progress) -> bool:
    """Whether what is left is worth another look; before the first one it is."""
    if not progress.rounds:
        return True
    base, floor = progress.bench.standing(), _floor(progress.bench)
    if progress.bench.reference is None:
        return float(base.mean()) > _counts(progress.bench, NOISE)
    return float(base.mean()) - floor > max(progress.bench.config.gate * progress.whole(), STANDING * floor)


def finish(progress: Progress) -> None:
    """Decide whether something is left that has no name."""
    bench = progress.bench
    found = skill_of(bench.twin, bench.target.roller, bench.config.stride)
    progress.explained = None if found is None else found.share
    poor = found is not None and found.share < POOR
    if bench.reference is None:
        well = found is not None and found.share >= WELL
        progress.left = not well and float(bench.standing().mean()) > _counts(bench, UNEXPLAINED)
        progress.unknown = (progress.left and not progress.named) or poor
        return
    suspect, reference = bench.standing(), _reference_losses(bench)
    if min(len(suspect), len(reference)) < FEWEST:
        loud = float(suspect.mean()) > USUALLY * float(reference.mean())
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
    return scaled(dataclasses.replace(bench, twin=twin, reference_twin=reference, free=free))


def _counts(bench: Bench, loss: float) -> float:
    """What a set counts all windows of which have this loss."""
    return float(counted(np.array(loss), bench.target.usual))


def _floor(bench: Bench) -> float:
    """Mean loss of the reference; without one nobody knows it."""
    return float(_reference_losses(bench).mean()) if bench.reference is not None else 0.0


def _reference_losses(bench: Bench) -> Array:
    assert bench.reference is not None
    return standing_of(bench.reference_twin, bench.reference)


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
    before = float(bench.counting(IN_FULL).standing()[bench.train].mean())
    rows = []
    pace = Pace(len(kept), progress.journal)
    for n, s in enumerate(kept):
        if n % TOLD == 1:
            tell(f"round {number + 1}: first {QUICK} steps of the promising ones {n}/{len(kept)}{pace.left(n)}")
        progress.go_on(number)
        z, loss = quick(bench, s, progress.journal, f"{number}/quick/{s.trial.id}")
        rows.append((before - loss, dataclasses.replace(s, starts=[Start(z, before - loss)])))
    rows.sort(key=lambda row: -row[0])
    tell(f"round {number + 1}: ahead after {QUICK} steps: " + ", ".join(r[1].trial.id for r in rows[:4]))
    least = max(BEHIND * rows[0][0], worth)
    return [s for n, (saved, s) in enumerate(rows) if n < FEW or (n < FINALISTS and saved >= least)]

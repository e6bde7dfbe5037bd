"""The first question to a plain spring-mass line: does it resist bending by its angles, not by springs that skip?

Springs between particles that are not neighbours resist bending only in the second order of the angle, and shorten
the line's chords. It is a cause of another kind than the effects: the springs themselves change.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import t as student

from pred_core.diagnose.commission import base_fields, refined, values_of, with_stored
from pred_core.diagnose.evidence import Judged, family_wise
from pred_core.diagnose.fit import Target
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import TRUST, Bench, Tell, standing_of
from pred_core.diagnose.pace import Pace
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.trial import Trial, make_trial
from pred_core.effects import find_effect
from pred_core.effects.effect import Effect
from pred_core.twin import Extension, Twin

ID = "bending_by_angle"
FAMILY = "bending"
GRID = tuple(float(v) for v in np.logspace(-5, -1, 9))  # [N m^2] bending stiffnesses tried first
COMPANION = find_effect("bending_damping")
TIMES = (0.03, 0.1)  # [s] of damping tried first
STIFF = (1.0, 10.0, 100.0)  # axial stiffnesses tried first, over the present one


def applies(twin: Twin) -> bool:
    """A line whose bending is left to springs that skip particles, or to nothing."""
    body = twin.body
    if body.kind != "line" or twin.physics.bending_stiffness != 0.0 or len(body.bends) == 0:
        return False
    springs = {tuple(sorted(s)) for s in body.springs.tolist()}
    return _neighbours(twin) <= springs  # one line, whose neighbours are all connected


def chain(twin: Twin) -> Twin:
    """The twin with springs between neighbours alone."""
    body, neighbours = twin.body, _neighbours(twin)
    keep = np.array([tuple(sorted(s)) in neighbours for s in body.springs.tolist()])
    slim = dataclasses.replace(
        body,
        springs=np.ascontiguousarray(body.springs[keep]),
        rest_length=body.rest_length[keep],
        stiffness_scale=body.stiffness_scale[keep],
        damping_scale=body.damping_scale[keep],
    )
    longest = 1.001 * float(slim.rest_length.max())
    physics = dataclasses.replace(twin.physics, max_springs=2, connection_threshold=longest, bending_stiffness=1e-3)
    return twin.replace(body=slim, physics=physics)


def _neighbours(twin: Twin) -> set[tuple[int, ...]]:
    """Pairs of particles that follow each other along the line."""
    bends = np.asarray(twin.body.bends)
    path = [*bends[:, 0].tolist(), *bends[-1, 1:].tolist()]
    return {tuple(sorted(p)) for p in zip(path[:-1], path[1:], strict=True)}


def question(bench: Bench, journal: Journal, tell: Tell) -> tuple[Bench, Judged, float] | None:
    """The bench with a chain instead, what that gains on held-out recordings, and its p value; None: no gain.

    Springs that skip particles also take energy out of bending, a chain does not. Where the chain alone gains little it
    is judged together with damping in its bends; the bench then has the chain without it, so that the damping must be
    found like any other cause.
    """
    before = bench.standing()
    best = _asked(bench, (), journal, "structure", tell)
    tell(f"bending by angle: gain {best.judged.mean:.3f} of {before.mean():.3f}")
    least, looks = bench.config.cold_gate * float(before.mean()), 1
    if best.judged.mean < least:
        looks = 2
        best = _asked(bench, (COMPANION,), journal, "structure/damped", tell)
        tell(f"bending by angle, with damping: gain {best.judged.mean:.3f} of {before.mean():.3f}")
    groups = bench.target.roller.sample.groups
    p = min(1.0, looks * float(family_wise([best.judged], bench.config.seed, groups)[0]))
    if p > bench.config.level or best.judged.mean < least:
        return None
    twin = best.twin.replace(extensions=bench.twin.extensions)
    changed = dataclasses.replace(
        bench,
        twin=twin,
        reference_twin=twin,
        target=_on(twin, bench.target),
        fitted=_on(twin, bench.fitted),
        physics=base_fields(twin),
    )
    return changed, best.judged, p


@dataclass(frozen=True)
class _Asked:
    """A chain that was fitted, and what it gains over the springs as they are."""

    twin: Twin
    judged: Judged


def _asked(bench: Bench, beside: tuple[type[Effect], ...], journal: Journal, key: str, tell: Tell) -> _Asked:
    """Fit the chain, with effects `beside` it, on the train episodes; judge it by parameters of other recordings."""
    fitted, target = bench.fitted, bench.target
    slim = _with(chain(bench.twin), beside)
    with_damping = " with damping" if beside else ""

    def fit_chain() -> dict[str, object]:
        tell(f"bending by angle{with_damping}: a coarse grid, then a fit without each recording")
        twin = refined(_first(slim, beside, fitted), fitted, None, beside=beside)
        rows = []
        groups = fitted.roller.sample.groups
        every = sorted(set(groups.tolist()))
        pace = Pace(len(every), journal)
        for n, group in enumerate(every, 1):
            keep = np.flatnonzero(groups != group).tolist()
            own = refined(twin, fitted.part(keep), None, steps=1, beside=beside) if keep else twin
            rows.append([int(group), values_of(own)])
            tell(f"bending by angle{with_damping}: fitted without {n}/{len(every)} recordings{pace.left(n)}")
        return {"twin": values_of(twin), "without": rows}

    def read(stored: dict[str, Any]) -> tuple[Twin, dict[int, Twin]]:
        without = {int(group): with_stored(slim, values) for group, values in stored["without"]}
        if set(without) != set(fitted.roller.sample.groups.tolist()):
            raise ValueError(f"fits without {len(without)} recordings, expected one without each")
        return with_stored(slim, stored["twin"]), without

    twin, without = journal.piece(key, fit_chain, read)
    base = standing_of(bench.twin, target)
    extended = standing_of(twin, target)
    for group, other in without.items() if bench.config.cross_fit else ():
        mine = target.roller.sample.groups == group
        if mine.any():
            extended[mine] = standing_of(other, target)[mine]
    trial = _trial(twin)
    knobs = trial.space.knobs
    value = twin.physics.bending_stiffness
    width = _width([t.physics.bending_stiffness for t in without.values()], value)
    judged = Judged(
        trial=trial,
        values={k.name: value for k in knobs},
        null={k.name: 0.0 for k in knobs},
        intervals={k.name: (max(value - width, 0.0), value + width) for k in knobs},
        gain=base - extended,
        acts=np.ones(len(base), dtype=bool),
        extended=extended,
        z=trial.space.start(),
    )
    return _Asked(twin, judged)


def _width(spread: Sequence[float], value: float) -> float:
    """Half a 90 % interval of the value, by the jackknife over recordings as `judge.intervals` has it; of one recording
    nothing is known."""
    groups = len(spread)
    return float(student.ppf(TRUST, groups - 1) * np.std(spread)) * (groups - 1) ** 0.5 if groups > 1 else value


def _with(twin: Twin, effects: tuple[type[Effect], ...]) -> Twin:
    """The twin with these effects, off."""
    off = tuple(Extension(e.id, 1, {q.name: (q.null,) * q.size for q in e.parameters}) for e in effects)
    return twin.replace(extensions=(*twin.extensions, *off))


def _first(slim: Twin, beside: tuple[type[Effect], ...], fitted: Target) -> Twin:
    """The best of a coarse grid: bending stiffness spans many orders of magnitude."""
    twins = [
        slim.replace(
            physics=dataclasses.replace(slim.physics, bending_stiffness=b, stiffness=s * slim.physics.stiffness)
        )
        for b in GRID
        for s in STIFF
    ]
    usual = max(Roller(slim, fitted.roller.sample).usual(), float(slim.meta.substeps or 1))
    possible = [t for t in twins if Roller(t, fitted.roller.sample).usual() <= 3.0 * usual] or twins[:1]
    if beside:
        possible = [_damped(t, time) for t in possible for time in TIMES]
    return min(possible, key=lambda t: float(standing_of(t, fitted).mean()))


def _damped(twin: Twin, time: float) -> Twin:
    """The twin whose last extension, the damping, has this time [s]."""
    *others, last = twin.extensions
    return twin.replace(extensions=(*others, dataclasses.replace(last, parameters={"time": (time,)})))


def _on(twin: Twin, target: Target) -> Target:
    return dataclasses.replace(target, roller=Roller(twin, target.roller.sample))


def _trial(twin: Twin) -> Trial:
    space = make_trial(twin, (), ("bending_stiffness",)).space
    return Trial((ID,), FAMILY, space, (0,))

"""From what a diagnosis found to what it says: causes, errors in millimetres, budget, twin."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pred_core.calibration import Calibration
from pred_core.config import to_mapping
from pred_core.diagnose.causes import causes_of, evidence_of
from pred_core.diagnose.errors import EpisodeErrors, episode_errors, gain_of
from pred_core.diagnose.evidence import FEWEST_ACTING
from pred_core.diagnose.gate import GateResult
from pred_core.diagnose.judge import Bench, Tell
from pred_core.diagnose.naming import exploratory, one_recording
from pred_core.diagnose.next_motion import propose
from pred_core.diagnose.progress import Progress
from pred_core.diagnose.ranking import EVEN, ranking
from pred_core.diagnose.refining import Refined, moved, refining_said
from pred_core.diagnose.result import Cause, Diagnosis, Errors
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.said import not_identifiable, sentence, unmoved, unproven, without_interval
from pred_core.diagnose.seen import seen_only
from pred_core.twin import Twin
from pred_core.types import Episode

CHEAP = 10.0  # [s] that replaying the given twin may take, for what refining changed
PARTLY = 0.3  # share of the excess from which what was measured is the answer although something is left


@dataclass(frozen=True)
class Study:
    """What a diagnosis began with."""

    raw: tuple[Episode, ...]
    corrected: tuple[Episode, ...]  # by what the gate found
    known: tuple[Episode, ...]  # the reference's, as its twin's calibration sees them; () without one
    given: Twin
    gate: GateResult
    bench: Bench  # before anything was named
    session: int  # [ns] its beginning


def answer(study: Study, progress: Progress, begin: float, tell: Tell) -> Diagnosis:
    """The whole answer; replays whole held-out episodes."""
    config = study.bench.config
    ranked = ranking(study.gate, progress)
    split = "test" if any(e.split == "test" for e in study.corrected) else "train"
    tell(f"errors on the {split} episodes")
    started = time.monotonic()
    errors = _errors(study, progress, split)
    refining = refining_of(study, errors, (time.monotonic() - started) / 2.0)
    budget = _budget(study, progress, errors)
    causes = causes_of(
        study.gate, progress, {r.id: r.probability for r in ranked}, closed_by_gate(study.gate, budget["named"], errors)
    )
    ood = _errors(study, progress, "ood") if any(e.split == "ood" for e in study.corrected) else None
    outcome = outcome_of(causes, progress)
    result = Diagnosis(
        outcome=outcome,
        sentence="",
        causes=causes,
        ranking=tuple(ranked),
        errors=errors,
        errors_ood=ood,
        budget=budget,
        not_identifiable=tuple(not_identifiable(progress, study.corrected)),
        not_testable=not_testable_in(study.gate, progress),
        next_motion=None,
        exploratory=exploratory(study.bench),
        notes=_notes(study, progress, causes, errors, ood, refining_said(refining, split)),
        gate=study.gate,
        rounds=tuple(progress.rounds),
        base_twin=study.bench.twin,
        twin=_twin(study, progress, causes),
        seconds=0.0,
        seed=config.seed,
        session=study.session,
        more=progress.unknown or progress.left,
        explained=progress.explained,
        settings=to_mapping(config),
        refined=refining,
        seen=seen_only(study.gate, progress),
    )
    result = dataclasses.replace(result, next_motion=propose(result, study.corrected, config.seed))
    return dataclasses.replace(result, sentence=sentence(result), seconds=time.monotonic() - begin)


def outcome_of(causes: Sequence[Cause], progress: Progress) -> str:
    """One of OUTCOMES, from what was found and whether something is left: with too little explained it is unknown.

    A law that was fitted must then be the answer more probably than not; what the gate measured is there by itself.
    """
    physics = [c for c in causes if not c.measured]
    cold = progress.bench.reference is None  # nobody knows there how much there is to explain
    least = progress.bench.config.enough if cold else EVEN if len(physics) == len(causes) else PARTLY
    if physics and physics[0].contradicted:  # only the nearest law
        return "unknown"
    if progress.unknown and explained_by(causes) < least:
        return "unknown"
    if not causes:
        return "none"
    return "group" if any(c.group for c in causes) else "named"


def explained_by(causes: Sequence[Cause]) -> float:
    """Share of the excess, 0 to 1, that causes explain together.

    Sensor causes are corrected all at once and share what that took away, so their shares add. Physics explains of what
    is left by then: each cause a share of its own round's excess, of which the largest counts.
    """
    sensors = min(sum(c.closed or 0.0 for c in causes if c.measured), 1.0)
    physics = max((c.closed or 0.0 for c in causes if not c.measured), default=0.0)
    return 1.0 - (1.0 - sensors) * (1.0 - physics)


def _twin(study: Study, progress: Progress, causes: Sequence[Cause]) -> Twin:
    """What was named, in the twin; with the substeps it needs, and beside it the base it was compared with."""
    final, given, first = progress.bench.twin, study.given, study.bench.twin
    needed = math.ceil(Roller(final, progress.bench.target.roller.sample).usual())
    substeps = None if given.meta.substeps is None else max(given.meta.substeps, needed)
    found = ", ".join(c.id for c in causes) or "nothing"
    notes = [*given.meta.notes, f"diagnosed: {found}"]
    if given.residual is not None:
        notes.append("the network of the twin that was questioned is not in this one: train it anew")
    if any(c.family == "drift" for c in causes):
        notes.append("what drifts begins anew with every start in a node: identify it again for another session")
    changed = [f.name for f in dataclasses.fields(final.physics)
               if getattr(final.physics, f.name) != getattr(given.physics, f.name)]  # fmt: skip
    return final.replace(
        meta=dataclasses.replace(given.meta, parent=given.digest(), substeps=substeps, notes=tuple(notes)),
        extensions=tuple(evidence_of(e, progress) for e in final.extensions),
        physics_report={k: v for k, v in given.physics_report.items() if k not in changed},
        calibration=study.gate.calibration,
        residual=None,
        base=first.replace(calibration=given.calibration, residual=None, base=None),
    )


def _errors(study: Study, progress: Progress, split: str) -> Errors:
    """Base: data as the given twin's own calibration sees it; extended: with what the gate found corrected."""
    before = episode_errors(study.bench.twin, _before(study, split), study.session)
    after = episode_errors(progress.bench.twin, _after(study, split), study.session)
    return Errors(split, before, after, floor_of(study, split), gain_of(before, after, study.bench.config.seed))


def floor_of(study: Study, split: str) -> float | None:
    """Mean error [mm] of the reference's episodes of a split with its own twin, whose session began with the first of
    all it was fitted on; None without such episodes."""
    same = [e for e in study.known if e.split == split]
    if not same:
        return None
    begin = min(int(e.stamps[0]) for e in study.known)
    return episode_errors(study.bench.reference_twin, same, begin).mean


def _before(study: Study, split: str) -> list[Episode]:
    return [study.given.calibration.correct(e) for e in study.raw if e.split == split]


def _after(study: Study, split: str) -> list[Episode]:
    return [e for e in study.corrected if e.split == split]


def _budget(study: Study, progress: Progress, errors: Errors) -> dict[str, Any]:
    """The held-out error [mm] stage by stage: what each cause takes away in the order they were named, and what is
    left. What correcting the data takes away is shared among sensor causes by their size at the object.
    """
    episodes = _after(study, errors.split)
    stages: list[EpisodeErrors] = [episode_errors(t, episodes, study.session) for t in progress.twins]
    named: dict[str, float] = {}
    sensors = [c for c in study.gate.accepted if c.id in study.gate.sensor_ids]
    size = sum(c.effect_mm for c in sensors) or 1.0
    for c in sensors:
        named[c.id] = (errors.base.mean - stages[0].mean) * c.effect_mm / size
    for n, (one, other) in zip(progress.named, zip(stages[:-1], stages[1:], strict=True), strict=True):
        named[n.judged.trial.id] = one.mean - other.mean
    floor = min(errors.floor or 0.0, errors.extended.mean)
    return {"named": named, "learned": 0.0, "unexplained": errors.extended.mean - floor, "floor": floor}


def closed_by_gate(gate: GateResult, named: Mapping[str, float], errors: Errors) -> dict[str, float | None]:
    """Sensor cause -> share, 0 to 1, of the excess error that its correction took away; None: there is no excess."""
    excess = errors.base.mean - (errors.floor or 0.0)
    return {
        c.id: min(max(named[c.id] / excess, 0.0), 1.0) if excess > 0.0 else None
        for c in gate.accepted
        if c.id in gate.sensor_ids
    }


def refining_of(study: Study, errors: Errors, took: float) -> Refined:
    """What the base is, and by how much it differs from the given twin. `took` [s] of replaying them with it."""
    source = "the train episodes" if study.bench.reference is None else "the reference"
    given = study.given.replace(calibration=Calibration(), residual=None)
    sample = study.bench.target.roller.sample
    took *= Roller(given, sample).usual() / Roller(study.bench.twin, sample).usual()
    before = None if took > CHEAP else episode_errors(given, _before(study, errors.split), study.session).mean
    return Refined(source, before, errors.base.mean, moved(given, study.bench.twin))


def not_testable_in(gate: GateResult, progress: Progress) -> Mapping[str, str]:
    """Candidate -> why these data cannot show it. One that they would show, and that is not there, is none of them."""
    rows = {c.id: c.why for c in gate.causes if not c.testable}
    found = [i for n in progress.named for i in n.judged.trial.ids]
    hardly = "these motions hardly excite it: a typical change of it moves {} of {} episodes"
    for r in progress.rounds:
        idle = {j.trial.id: j.excited or 0 for j, _, why in r.judged if why and not j.testable}
        idle |= {id: n for id, n in r.excited.items() if n < min(FEWEST_ACTING, len(r.base))}
        rows |= {id: hardly.format(n, len(r.base)) for id, n in idle.items() if id not in found}
        rows |= {id: why for id, why in r.passed.items() if id not in found}
    shown = {j.trial.id for r in progress.rounds for j, _, _ in r.judged if j.testable}
    return {id: why for id, why in rows.items() if id not in shown}


def _notes(
    study: Study, progress: Progress, causes: Sequence[Cause], errors: Errors, ood: Errors | None, refining: str
) -> tuple[str, ...]:
    rows = [
        *study.gate.notes,
        *progress.notes,
        refining,
        unproven(causes, errors, study.bench.config.window),
        unmoved(causes, errors),
        one_recording(study.bench),
        without_interval(causes),
    ]
    for e in (errors, ood):
        for title, side in () if e is None else (("base", e.base), ("extended", e.extended)):
            if side.diverged:
                rows.append(f"{title}: the simulation diverged in {', '.join(side.diverged)}; counted as 0.5 m")
    if study.bench.reference is None:
        rows.append("no reference: what the engine and the object lack in common may carry a cause's name")
    if study.bench.config.left_out:
        rows.append(f"left out to measure what they are worth: {', '.join(study.bench.config.left_out)}")
    if study.given.residual is not None:
        rows.append("the twin's network was left out: the base is its simulation alone")
    return tuple(row for row in rows if row)

"""The whole diagnosis: gate, commissioning, rounds, errors, budget, twin."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any

from pred_core.diagnose.commission import commission
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.errors import episode_errors, gain_of
from pred_core.diagnose.gate import GateCause, GateResult, measure
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Bench, Tell
from pred_core.diagnose.next_motion import propose
from pred_core.diagnose.ranking import confidence, ranking
from pred_core.diagnose.result import Cause, Diagnosis, Errors, Value
from pred_core.diagnose.rounds import FEWEST, Named, Progress, finish, one_round
from pred_core.diagnose.said import not_identifiable, sentence
from pred_core.diagnose.structure import FAMILY, ID, applies, question
from pred_core.effects import find_effect
from pred_core.errors import DatasetError
from pred_core.twin import Extension, Twin
from pred_core.types import Episode

MEASURED = ("delay", "camera_scale", "camera_rotation", "camera_translation", "gripper_offset")


def diagnose(
    episodes: Sequence[Episode],
    twin: Twin,
    reference: Sequence[Episode] | None,
    config: DiagnoseConfig,
    tell: Tell,
    journal: Journal | None = None,
    begin: float | None = None,
) -> Diagnosis:
    """What these episodes say the twin gets wrong. Splits as in the data set: train is fitted, test judges, ood is
    only reported.

    Raises: DatasetError if episodes are too few or too short, or the twin does not describe them.
    """
    begin = time.monotonic() if begin is None else begin
    train = [e for e in episodes if e.split == "train"]
    if not train:
        raise DatasetError(
            "there is nothing to fit a cause to",
            got="no episode with split 'train'",
            allowed="1 or more; 10 train and test episodes for a name that holds",
            next_step="Record more episodes with different motions",
        )
    known = [e for e in reference or () if e.split != "ood"]
    gate = measure(train, [e for e in known if e.split == "train"] or None, twin)
    for cause in gate.accepted:
        tell(f"gate: {cause.id}: {cause.effect_mm:.1f} mm at the object, p {cause.p_adjusted:.3g}")
    corrected = [gate.calibration.correct(e) for e in episodes]
    known = [twin.calibration.correct(e) for e in known]
    plain = twin.replace(calibration=type(twin.calibration)(), residual=None)
    journal = journal or Journal(None, {})
    bench = commission(plain, [e for e in corrected if e.split != "ood"], known, config, tell, journal)
    progress = Progress(bench, journal)
    if bench.reference is None and applies(bench.twin):
        _change_structure(progress, tell)
    for number in range(config.causes):
        if not one_round(progress, tell, number):
            break
        found = progress.named[-1]
        tell(f"named: {found.judged.trial.id}, closes {found.closed:.0%} of the excess")
    finish(progress)
    return _answer(progress, bench, gate, twin, episodes, corrected, known, config, begin, tell)


def _change_structure(progress: Progress, tell: Tell) -> None:
    """Name bending by angle, if a chain with it is better than the springs as they are."""
    base = progress.bench.standing()
    found = question(progress.bench, progress.journal, tell)
    if found is None:
        return
    bench, judged, p = found
    closed = judged.mean / float(base.mean())
    if closed < progress.bench.config.cold_gate:
        return
    progress.named.append(Named(judged, p, (), closed, -1))
    progress.bench = bench


def _answer(
    progress: Progress,
    first: Bench,
    gate: GateResult,
    twin: Twin,
    raw: Sequence[Episode],
    corrected: Sequence[Episode],
    known: Sequence[Episode],
    config: DiagnoseConfig,
    begin: float,
    tell: Tell,
) -> Diagnosis:
    final = progress.bench.twin
    causes = (*_measured(gate), *_named(progress.named, first.reference is not None))
    extended = final.replace(extensions=tuple(_evidence(e, progress.named) for e in final.extensions))
    base = first.twin
    split = "test" if any(e.split == "test" for e in corrected) else "train"
    tell(f"errors on the {split} episodes")
    errors = _errors(split, base, extended, raw, corrected, known, first, twin, config)
    ood = _errors("ood", base, extended, raw, corrected, (), first, twin, config) if any(
        e.split == "ood" for e in corrected
    ) else None  # fmt: skip
    exploratory = len([e for e in corrected if e.split != "ood"]) < FEWEST
    outcome = _outcome(causes, progress)
    ranked = ranking(progress.rounds, progress.named, progress.unknown)
    report = dataclasses.replace(
        twin.meta, parent=twin.digest(), notes=(*twin.meta.notes, f"diagnosed: {', '.join(c.id for c in causes) or outcome}")
    )
    answer = Diagnosis(
        outcome=outcome,
        sentence="",
        causes=causes,
        ranking=tuple(ranked),
        errors=errors,
        errors_ood=ood,
        budget=_budget(progress, first, errors, gate),
        not_identifiable=tuple(not_identifiable(progress, corrected)),
        not_testable={c.id: c.why for c in gate.causes if not c.testable},
        next_motion=None,
        exploratory=exploratory,
        notes=tuple(gate.notes),
        gate=gate,
        rounds=tuple(progress.rounds),
        base_twin=base,
        twin=extended.replace(meta=report, calibration=gate.calibration, base=twin.replace(residual=None, base=None)),
        seconds=time.monotonic() - begin,
        seed=config.seed,
    )
    answer = dataclasses.replace(answer, next_motion=propose(answer, corrected, config.seed))
    return dataclasses.replace(answer, sentence=sentence(answer), seconds=time.monotonic() - begin)


def _outcome(causes: Sequence[Cause], progress: Progress) -> str:
    if not causes:
        return "unknown" if progress.unknown else "none"
    if progress.unknown and not any(c.measured for c in causes):
        best = max((c.closed for c in causes), default=0.0)
        if best < progress.bench.config.enough:
            return "unknown"
    return "group" if causes[0].group else "named"


def _measured(gate: GateResult) -> list[Cause]:
    rows = []
    for c in gate.accepted:
        if c.id in MEASURED:
            rows.append(Cause(c.id, _family(c), 1.0 - c.p_adjusted, _gate_values(c), True, 1.0, c.p_adjusted))
    return rows


def _family(cause: GateCause) -> str:
    return {"delay": "delay", "gripper_offset": "gripper_offset"}.get(cause.id, "camera")


def _gate_values(cause: GateCause) -> dict[str, Value]:
    rows: dict[str, Value] = {}
    for name, values in cause.parameters.items():
        spans = cause.interval.get(name, ())
        for k, value in enumerate(values):
            low, high = spans[k] if k < len(spans) else (value, value)
            rows[name if len(values) == 1 else f"{name}[{k}]"] = Value(value, cause.unit, low, high)
    return rows


def _named(named: Sequence[Named], floor: bool) -> list[Cause]:
    rows = []
    for n in named:
        j = n.judged
        if j.trial.ids == (ID,):
            name = j.trial.space.knobs[0].name
            value = Value(j.values[name], j.trial.space.knobs[0].unit, *j.intervals[name])
            rows.append(Cause(ID, FAMILY, confidence(n, floor), {name: value}, False, n.closed, n.p_adjusted))
            continue
        for id in j.trial.ids:
            effect = find_effect(id)
            values = {}
            for knob in j.trial.space.knobs:
                if not knob.name.startswith(f"{id}."):
                    continue
                name = knob.name.split(".", 1)[1]
                size = next(q.size for q in effect.parameters if q.name == name.split("[")[0])
                low, high = j.intervals[knob.name]
                values[name if size > 1 else name.split("[")[0]] = Value(
                    j.values[knob.name], knob.unit, low, high, j.at_bound[knob.name]
                )
            rows.append(
                Cause(id, effect.family, confidence(n, floor), values, False, n.closed, n.p_adjusted, n.group)
            )
    return rows


def _evidence(extension: Extension, named: Sequence[Named]) -> Extension:
    for n in named:
        if extension.id in n.judged.trial.ids:
            better, acting = n.judged.improved
            evidence: Mapping[str, Any] = {
                "found_by": "pred diagnose",
                "p_adjusted": n.p_adjusted,
                "closed": n.closed,
                "episodes_improved": f"{better}/{acting}",
                "interval": {k: list(v) for k, v in n.judged.intervals.items() if k.startswith(f"{extension.id}.")},
                "group": list(n.group),
            }
            return dataclasses.replace(extension, evidence=evidence)
    return extension


def _errors(
    split: str,
    base: Twin,
    extended: Twin,
    raw: Sequence[Episode],
    corrected: Sequence[Episode],
    known: Sequence[Episode],
    first: Bench,
    given: Twin,
    config: DiagnoseConfig,
) -> Errors:
    """Base: data as the twin's own calibration sees it; extended: with what the gate found corrected."""
    before = episode_errors(base, [given.calibration.correct(e) for e in raw if e.split == split])
    after = episode_errors(extended, [e for e in corrected if e.split == split])
    floor = None
    same = [e for e in known if e.split == split]
    if same:
        floor = episode_errors(first.reference_twin, same).mean
    return Errors(split, before, after, floor, gain_of(before, after, config.seed))


def _budget(progress: Progress, first: Bench, errors: Errors, gate: GateResult) -> dict[str, Any]:
    """Shares of the held-out error [mm]: what each cause takes away, in the order they were named, and what is left."""
    total = errors.base.mean - errors.extended.mean
    shares = [max(n.judged.mean, 0.0) for n in progress.named]
    measured = [c for c in gate.accepted if c.id in MEASURED]
    named: dict[str, float] = {}
    whole = sum(shares) or 1.0
    parts = len(measured) + (1 if shares else 0)
    for c in measured:
        named[c.id] = total / parts
    for n, share in zip(progress.named, shares, strict=True):
        named[n.judged.trial.id] = total * share / whole / (parts if measured else 1)
    floor = errors.floor or 0.0
    return {
        "named": named,
        "learned": 0.0,
        "unexplained": max(errors.extended.mean - floor, 0.0),
        "floor": min(floor, errors.extended.mean),
    }



"""The causes that were found, with their parameters, and the evidence a twin carries of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from pred_core.diagnose.gate import GateCause, GateResult
from pred_core.diagnose.naming import one_recording
from pred_core.diagnose.progress import Named, Progress
from pred_core.diagnose.result import Cause, Value
from pred_core.diagnose.structure import FAMILY, ID
from pred_core.effects import LIBRARY, find_effect
from pred_core.identify.space import Knob
from pred_core.twin import Extension


def causes_of(
    gate: GateResult, progress: Progress, probability: Mapping[str, float], closed: Mapping[str, float | None]
) -> tuple[Cause, ...]:
    """Sensor causes first, then physics in the order it was named. `closed`: share of the excess error that correcting
    each sensor cause took away."""
    rows = [
        Cause(c.id, family_of(c.id), probability[c.id], _gate_values(c), True, closed[c.id], c.p_adjusted,
              c.confused_with)
        for c in gate.accepted
        if c.id in gate.sensor_ids
    ]  # fmt: skip
    single = bool(one_recording(progress.bench))
    for n in progress.named:
        rows += _named(n, probability, single)
    names = {c.id for c in rows}
    return tuple(dataclasses.replace(c, group=tuple(g for g in c.group if g not in names)) for c in rows)


def family_of(id: str) -> str:
    """Family of any cause."""
    if id == ID:
        return FAMILY
    return LIBRARY[id].family if id in LIBRARY else "camera"


def _named(n: Named, probability: Mapping[str, float], single: bool) -> list[Cause]:
    """One cause, or two; `single`: all train episodes are of one recording, which tells of no scatter."""
    j = n.judged
    sure = probability[j.trial.id]
    if j.trial.ids == (ID,):
        knob = j.trial.space.knobs[0]
        value = Value(j.values[knob.name], knob.unit, *j.intervals[knob.name], interval=not single)
        return [Cause(ID, FAMILY, sure, {knob.name: value}, False, n.closed, n.p_adjusted)]
    rows = []
    for id in j.trial.ids:
        effect = find_effect(id)
        values = {}
        for knob in j.trial.space.knobs:
            if not knob.name.startswith(f"{id}."):
                continue
            name = knob.name.split(".", 1)[1]
            plain = name.split("[")[0]
            size = next(q.size for q in effect.parameters if q.name == plain)
            low, high = j.intervals[knob.name]
            values[name if size > 1 else plain] = Value(
                j.values[knob.name], knob.unit, low, high, j.at_bound[knob.name],
                interval=not single and _measured(knob, (low, high)),
            )  # fmt: skip
        rows.append(Cause(id, effect.family, sure, values, False, n.closed, n.p_adjusted, n.group, n.contradicted))
    return rows


def _measured(knob: Knob, span: tuple[float, float]) -> bool:
    """Whether an interval is narrower than the search."""
    return span != (knob.low, knob.high)


def _gate_values(cause: GateCause) -> dict[str, Value]:
    rows: dict[str, Value] = {}
    for name, values in cause.parameters.items():
        spans: Sequence[tuple[float, float]] = cause.interval.get(name, ())
        for k, value in enumerate(values):
            low, high = spans[k] if k < len(spans) else (value, value)
            key = name if len(values) == 1 else f"{name}[{k}]"
            rows[key] = Value(value, cause.unit, low, high, interval=k < len(spans))
    return rows


def evidence_of(extension: Extension, progress: Progress) -> Extension:
    """The extension with how it was found."""
    for n in progress.named:
        if extension.id in n.judged.trial.ids:
            better, acting = n.judged.improved
            known = not one_recording(progress.bench)
            spans = {
                k.name: list(n.judged.intervals[k.name]) if known and _measured(k, n.judged.intervals[k.name]) else None
                for k in n.judged.trial.space.knobs
                if k.name.startswith(f"{extension.id}.")
            }  # None: nobody measured one
            evidence = {
                "found_by": "pred diagnose",
                "p_adjusted": n.p_adjusted,
                "closed": n.closed,
                "episodes_improved": f"{better}/{acting}",
                "interval": spans,
                "group": list(n.group),
            }
            return dataclasses.replace(extension, evidence=evidence)
    return extension

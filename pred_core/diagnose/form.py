"""Whether what was named is the law, or the nearest one of the library: its power is freed and judged like a cause.

A law that is only near explains most of the error too: drag with the power 3/2 of the speed is fitted by the square to
a sixth of what it adds. A power fitted beside it tells the two apart, for it moves the shape of a motion and not its
size: on development cases it is 1.48 to 1.56 for the power 3/2, and within 0.05 of the law's own where the law is
right.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from pred_core.diagnose.commission import with_values
from pred_core.diagnose.evidence import Judged, family_wise
from pred_core.diagnose.fit import fit
from pred_core.diagnose.gate_result import GateResult
from pred_core.diagnose.journal import vector
from pred_core.diagnose.judge import Bench, Tell, intervals, standing_of
from pred_core.diagnose.left_out import without_each
from pred_core.diagnose.progress import Named, Progress
from pred_core.diagnose.trial import Trial, make_trial, switch
from pred_core.effects import LIBRARY, find_effect
from pred_core.effects.effect import Effect
from pred_core.twin import Extension, Twin
from pred_core.types import Array

STEPS = 4  # of both laws, from where the named one is
WORTH = 0.03  # of what the law saved: what the free power must save beyond it
APART = 0.2  # of a power: what engines differ by, and more, that its interval must keep from the law's


@dataclass(frozen=True)
class _Refit:
    """All that was named, fitted together once more."""

    trial: Trial
    z: Array  # (P,)
    left_out: Array  # (R, P) coordinates without each recording
    losses: Array  # (E,) cross-fitted


def check_forms(progress: Progress, tell: Tell) -> None:
    """Put the law with a free power in the place of every named one that the data contradict."""
    laws = [(n, id) for n in progress.named for id in n.judged.trial.ids if _form(id) is not None]
    for named, id in laws:
        _check(progress, next(n for n in progress.named if n.round == named.round), id, len(laws), tell)


def check_table(progress: Progress, gate: GateResult) -> None:
    """No plane is the law of a table on which particles do not rest on one, whatever a plane explains."""
    relief = gate.cause("table_relief")
    if not relief.accepted:
        return
    said = f"what rests on it does not lie on a plane: {relief.why}"
    flat = [n for n in progress.named if "table" in n.judged.trial.family.split("+")]
    progress.named = [dataclasses.replace(n, contradicted=said) if n in flat else n for n in progress.named]
    progress.unknown |= not progress.named


def _form(id: str) -> type[Effect] | None:
    """The law with a free power that a cause is one of; None: there is none."""
    return find_effect(LIBRARY[id].form) if id in LIBRARY and LIBRARY[id].form else None


def _check(progress: Progress, named: Named, id: str, laws: int, tell: Tell) -> None:
    """Judge one law; `laws`: how many are judged, what the level is divided by."""
    bench, form = progress.bench, _form(id)
    assert form is not None
    own = _refit(progress, bench, f"form/{id}/own")
    other = _in_form(bench, id, form)
    free = _refit(progress, other, f"form/{id}/free")
    listed = _of(other.twin, form.id).parameters["power"][0]
    j = _judged(named, other, id, form, free, own)
    knob = f"{form.id}.power[0]"
    power, (low, high) = j.values[knob], j.intervals[knob]
    gain = own.losses - free.losses
    test = dataclasses.replace(j, gain=gain)
    p = min(1.0, laws * float(family_wise([test], bench.config.seed, bench.target.roller.sample.groups)[0]))
    tell(f"form of {id}: power {power:.2f} [{low:.2f}, {high:.2f}] for {listed:g}, gain {gain.mean():.3f}, p {p:.3g}")
    apart = low > listed + APART or high < listed - APART
    if not apart or p > bench.config.level or float(gain.mean()) < WORTH * _saved(progress, named):
        return
    said = f"its power is {power:.2f} [{low:.2f}, {high:.2f}], not {listed:g} (p {p:.2g})"
    twin = with_values(other.twin, free.trial.space.candidate(free.z))
    instead = dataclasses.replace(named, judged=j, group=(), contradicted=said)
    progress.replace(named, instead, dataclasses.replace(other, twin=twin))


def _saved(progress: Progress, named: Named) -> float:
    """Mean loss that a name took away, in the units of the present round."""
    n = progress.named.index(named)
    before, after = (standing_of(t, progress.bench.target).mean() for t in progress.twins[n : n + 2])
    return max(float(before - after), 0.0)


def _in_form(bench: Bench, id: str, form: type[Effect]) -> Bench:
    """The bench with the same law written as one with a free power."""

    def written(twin: Twin) -> Twin:
        law = _of(twin, id)
        same = Extension(form.id, form.version, find_effect(id).in_form(law.parameters, twin.physics))
        return twin.replace(extensions=tuple(same if e.id == id else e for e in twin.extensions))

    return dataclasses.replace(
        bench,
        twin=written(bench.twin),
        reference_twin=written(bench.reference_twin),
        free=tuple(form.id if f == id else f for f in bench.free),
    )


def _of(twin: Twin, id: str) -> Extension:
    return next(e for e in twin.extensions if e.id == id)


def _refit(progress: Progress, bench: Bench, key: str) -> _Refit:
    trial = make_trial(bench.twin, (), bench.physics, bench.free)
    target, groups = bench.target, bench.target.roller.sample.groups

    def work() -> dict[str, object]:
        found = fit(bench.fitted, trial.space, trial.space.start(), STEPS)
        left_out = without_each(target, trial.space, found, bench.train)
        crossed = target.losses(trial.space, [found.z])[0]
        for group, other in left_out.items() if bench.config.cross_fit else ():
            crossed[groups == group] = other.loss[groups == group]
        rows = [other.z.tolist() for other in left_out.values()] or [found.z.tolist()]
        return {"z": found.z.tolist(), "left_out": rows, "losses": crossed.tolist()}

    def read(v: Any) -> _Refit:
        size = len(trial.space.knobs)
        left_out = np.stack([vector(row, size) for row in v["left_out"]])
        return _Refit(trial, vector(v["z"], size), left_out, vector(v["losses"], target.roller.sample.episodes))

    return progress.journal.piece(key, work, read)


def _judged(named: Named, bench: Bench, id: str, form: type[Effect], free: _Refit, own: _Refit) -> Judged:
    """The named cause with the free power in the place of its law."""
    ids = tuple(form.id if i == id else i for i in named.judged.trial.ids)
    knobs = free.trial.space.knobs
    off = {k.name: k.null for k in knobs if k.name.startswith(f"{form.id}.")}
    null = {k.name: off.get(k.name, named.judged.null.get(k.name, k.start)) for k in knobs}
    on = {f"{i}.{switch(find_effect(i)).name}" for i in ids}
    switches = [n for n, k in enumerate(knobs) if k.name.split("[")[0] in on]
    trial = dataclasses.replace(free.trial, ids=ids, family=named.judged.trial.family, amplitudes=tuple(switches))
    nowhere = np.array([k.coordinate(null[k.name]) for k in knobs])
    return Judged(
        trial=trial,
        values=trial.space.values(free.z),
        null=null,
        intervals=intervals(trial, free.z, nowhere, free.left_out),
        gain=named.judged.gain + (own.losses - free.losses),
        acts=named.judged.acts,
        extended=free.losses,
        z=free.z,
    )

"""What the network's velocity is held against: every candidate cause, switched on a little."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from pred_core.diagnose.places import first_values
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.structure import FAMILY, ID, applies
from pred_core.diagnose.trial import NOT_A_NAME, scanned, switch
from pred_core.effects import LIBRARY
from pred_core.effects.effect import Effect, Parameter
from pred_core.identify.space import Candidate
from pred_core.twin import Extension, Twin
from pred_core.types import Array, Physics

PLACES = 8  # where a localized cause is tried
BENDING = 1e-4  # [N m^2] a little, for twins whose springs alone resist bending
STEP_IN_GRIP = "acts where the object is held, which a network does not move"
IN_SENSOR = "a sensor's, not a force"
TOO_FLEXIBLE = "fits anything, so it is no name"


@dataclass(frozen=True)
class Probe:
    """One parameter of one effect, moved from where the twin has it by an amount that matters."""

    effect: str
    family: str
    knob: str  # parameter[k]
    extension: Extension | None  # None: the probe is `bending`
    place: int = -1  # which of the places, of an effect that is tried in several; -1: it acts everywhere
    bending: float = 0.0  # [N m^2] given to a twin that has none: it may lack the angles themselves


@dataclass(frozen=True)
class Probes:
    """All of a twin. Effects are simulated together, each off but for the probe that moves it."""

    rows: tuple[Probe, ...]
    standing: tuple[Extension, ...]  # all effects of all probes, those of the twin first, each as the twin has it
    untested: dict[str, str]  # effect -> why it has no probe

    def extensions(self, probe: Probe | None) -> tuple[Extension, ...]:
        """Of one world: everything as it stands but the probe."""
        moved = None if probe is None else probe.extension
        return tuple(moved if moved is not None and e.id == moved.id else e for e in self.standing)

    def candidate(self, probe: Probe | None, physics: Physics) -> Candidate:
        """One world."""
        if probe is not None and probe.bending:
            physics = dataclasses.replace(physics, bending_stiffness=probe.bending)
        return Candidate(physics, self.extensions(probe))


def probes_of(roller: Roller, force: Array, rng: np.random.Generator) -> Probes:
    """The probes that can act on this twin. `force` (W, K, N): where the network acts, places are drawn there."""
    twin = roller.twin
    present = {e.id: e for e in twin.extensions}
    rows: list[Probe] = []
    untested: dict[str, str] = {}
    for effect in LIBRARY.values():
        why = _why_not(effect, twin, effect.id in present)
        if why:
            untested[effect.id] = why
        elif effect.id in present:
            rows += _moved(effect, present[effect.id], effect.parameters)
        elif scanned(effect):
            for n, begin in enumerate(first_values(effect, roller, force, PLACES, rng)):
                rows += [dataclasses.replace(p, place=n) for p in _moved(effect, begin, (switch(effect),))]
        else:
            rows += _moved(effect, _off(effect), (switch(effect),))
    ids = dict.fromkeys(p.effect for p in rows)
    if applies(twin):
        rows.append(Probe(ID, FAMILY, "bending_stiffness", None, bending=BENDING))
    added = tuple(LIBRARY[i].extension() for i in ids if i not in present)
    return Probes(tuple(rows), (*twin.extensions, *added), untested)


def _why_not(effect: type[Effect], twin: Twin, present: bool) -> str:
    if set(effect.hooks) == {"observe"}:
        return IN_SENSOR
    if "boundary" in effect.hooks:
        return STEP_IN_GRIP
    if effect.id in NOT_A_NAME:
        return TOO_FLEXIBLE
    if "contact" in effect.hooks and twin.scene.ground is None:
        return "there is no table"
    bends = len(twin.body.bends) > 0 and twin.physics.bending_stiffness > 0.0
    if {"bend", "bend_stiffness"} & set(effect.hooks) and not bends and not present:
        return "the twin does not bend by angles"
    return ""


def _off(effect: type[Effect]) -> Extension:
    """The effect off, and what matters only when it is on where a search would start it."""
    values = {q.name: (q.starts[0],) * q.size for q in effect.parameters[1:] if q.starts}
    return effect.extension(**values)


def _moved(effect: type[Effect], begin: Extension, parameters: tuple[Parameter, ...]) -> list[Probe]:
    """One probe a component, by what matters of it: upwards, or downwards where there is no room above."""
    rows = []
    for q in parameters:
        for k in range(q.size):
            values = list(begin.parameters[q.name])
            step = q.starts[0] - values[k] if q.starts and values[k] == q.null and q.starts[0] != q.null else q.typical
            if q.log and values[k] > 0.0:
                step = values[k] * min(q.typical, 0.5)
            values[k] += step if values[k] + step <= q.high else -step
            extension = dataclasses.replace(begin, parameters={**begin.parameters, q.name: tuple(values)})
            rows.append(Probe(effect.id, effect.family, f"{q.name}[{k}]", extension))
    return rows

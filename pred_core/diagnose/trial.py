"""One candidate cause: which parameters it frees, where a search begins."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.diagnose.roll import LOSS, MOST_FACTOR, MOST_LOSS
from pred_core.effects import find_effect
from pred_core.effects.effect import Effect, Parameter
from pred_core.identify.space import SearchSpace, search_space
from pred_core.twin import Twin

# Effects too flexible to be a name, they would explain anything, and the forms with a free power that laws are held
# against (`form.py`).
NOT_A_NAME = ("bending_profile", "mass_profile", "rest_curvature", "drag_power", "friction_power")


@dataclass(frozen=True)
class Trial:
    """Effects that are freed together, on top of what the twin already has."""

    ids: tuple[str, ...]
    family: str
    space: SearchSpace
    amplitudes: tuple[int, ...]  # knobs that switch it on

    @property
    def id(self) -> str:
        """Name."""
        return "+".join(self.ids)

    @property
    def most(self) -> float:
        """Times the twin's substeps that a search may need."""
        return MOST_LOSS if any(find_effect(i).family == LOSS for i in self.ids) else MOST_FACTOR


def make_trial(
    twin: Twin, effects: tuple[type[Effect], ...], physics: tuple[str, ...] = (), free: tuple[str, ...] = ()
) -> Trial:
    """A trial of these effects. `physics`: base parameters, `free`: effects of the twin, that are refitted with it."""
    ids = tuple(e.id for e in effects)
    space = search_space(twin.physics, physics, (*ids, *(f for f in free if f not in ids)), twin.extensions)
    amplitudes = []
    for n, knob in enumerate(space.knobs):
        effect = next((e for e in effects if knob.name.startswith(f"{e.id}.")), None)
        if effect is None:
            continue
        parameter = _parameter(effect, knob.name)
        if parameter is switch(effect):
            amplitudes.append(n)
    family = "+".join(dict.fromkeys(e.family for e in effects))
    return Trial(ids, family, space, tuple(amplitudes))


def switch(effect: type[Effect]) -> Parameter:
    """The parameter that switches an effect on: the first."""
    return effect.parameters[0]


def scanned(effect: type[Effect]) -> tuple[Parameter, ...]:
    """Parameters whose first values are tried in many places."""
    return tuple(q for q in effect.parameters if q.scan)


def _parameter(effect: type[Effect], knob: str) -> Parameter:
    name = knob.split(".", 1)[1].split("[", 1)[0]
    return next(q for q in effect.parameters if q.name == name)

"""One candidate cause: which parameters it frees, where a search begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pred_core.diagnose.roll import LOSS, MOST_FACTOR, MOST_LOSS, Roller
from pred_core.effects import find_effect
from pred_core.effects.effect import Effect, Parameter
from pred_core.identify.space import SearchSpace, search_space
from pred_core.twin import Extension, Twin
from pred_core.types import Array

# Effects that are measurement (corrected, not simulated) or too flexible to be a name: they would explain anything.
NOT_A_NAME = ("bending_profile", "mass_profile", "rest_curvature")
SOLID = "solid"
DEEP = (0.02, 0.2)  # [m] of the centre of something solid behind where it seems to push
ASKEW = 0.3  # by how much its direction is drawn off that of the push


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


def first_values(
    effect: type[Effect], roller: Roller, error: Array, count: int, rng: np.random.Generator
) -> list[Extension]:
    """Extensions with the switch at its null and the scanned parameters drawn; one, if nothing is scanned.

    `error` (W, K, N): size of the residual. Places are drawn where the residual is large, between what was predicted
    and what was measured, because there something acts.
    """
    if not scanned(effect):
        return [effect.extension()]
    weight = error.reshape(-1) ** 2
    weight = weight / weight.sum() if weight.sum() > 0 else np.full(weight.size, 1.0 / weight.size)
    w = roller.sample.windows
    stride = max(1, len(w.target) // error.shape[1])
    target = w.target[stride - 1 :: stride].movedim(0, 1)[:, : error.shape[1]].reshape(-1, 3).numpy()
    result = []
    for n in range(count):
        place = target[int(rng.choice(len(target), p=weight))] + rng.normal(0.0, 0.06, 3)
        values: dict[str, tuple[float, ...]] = {}
        for q in scanned(effect):
            if q.scan in ("place", SOLID):
                value = tuple(place.tolist())
            elif q.scan == "floor":
                value = tuple(place[:2].tolist())
            elif q.scan == "arc":
                value = (float(rng.uniform(q.low, q.high)),)
            else:  # direction
                angle = 2.0 * np.pi * n / count
                value = (q.typical * float(np.cos(angle)), q.typical * float(np.sin(angle)))
            values[q.name] = tuple(float(np.clip(v, q.low, q.high)) for v in value)
        result.append(effect.extension(**values))
    return result


def solid_values(
    effect: type[Effect], roller: Roller, push: Array, count: int, rng: np.random.Generator
) -> list[Extension]:
    """Extensions of something solid whose surface is where the object was measured, none for other effects.

    `push` (W, K, N, 3) [m]: from where the object was predicted to where it was measured. Drawn where that is large.
    """
    solid = next((q for q in scanned(effect) if q.scan == SOLID), None)
    vector = push.reshape(-1, 3)
    size = np.linalg.norm(vector, axis=1)
    if solid is None or not size.any():
        return []
    w = roller.sample.windows
    stride = max(1, len(w.target) // push.shape[1])
    target = w.target[stride - 1 :: stride].movedim(0, 1)[:, : push.shape[1]].reshape(-1, 3).numpy()
    result = []
    for row in rng.choice(len(size), count, p=size**2 / (size**2).sum()):
        away = vector[row] / size[row] + rng.normal(0.0, ASKEW, 3)
        depth = float(np.exp(rng.uniform(*np.log(DEEP))))
        place = target[row] - depth * away / np.linalg.norm(away)
        values: dict[str, float | tuple[float, ...]] = {switch(effect).name: depth, solid.name: tuple(place.tolist())}
        result.append(effect.extension(**values))
    return result

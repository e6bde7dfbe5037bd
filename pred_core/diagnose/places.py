"""Where a search for what acts in one place begins: places that are drawn, then a short global search from the best.

What acts in one place has no slope that would say in which other place it acts.
"""

from __future__ import annotations

from dataclasses import dataclass

import cma
import numpy as np

from pred_core.diagnose.fit import Target
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.trial import Trial, scanned, switch
from pred_core.effects.effect import Effect
from pred_core.twin import Extension
from pred_core.types import Array

SOLID = "solid"
DEEP = (0.02, 0.2)  # [m] of the centre of something solid behind where it seems to push
ASKEW = 0.3  # by how much its direction is drawn off that of the push
SPREAD = 0.7  # [typical changes] of the global search at first
STRONG = 0.5  # the same of a switch, as a share of how far it is on, where that is more than a typical change
GENERATIONS, CANDIDATES = 8, 12
APART = 1.0  # [typical changes] between starts that are kept
INSIDE = 1e-6  # [typical changes] of the bounds, where the global search must begin


@dataclass(frozen=True)
class Start:
    """A point to refine from, and what it saves there, or a straight line promises."""

    z: Array  # (P,) coordinates
    promise: float  # of the loss, averaged over all windows


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
    target = _measured(roller, error.shape[1])
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


def _measured(roller: Roller, frames: int) -> Array:
    """(W K N, 3) [m] world: where the object was measured at the K frames a window that residuals have."""
    target = roller.sample.windows.target
    stride = max(1, len(target) // frames)
    return np.asarray(target[stride - 1 :: stride].movedim(0, 1)[:, :frames].reshape(-1, 3).numpy())


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
    target = _measured(roller, push.shape[1])
    result = []
    for row in rng.choice(len(size), count, p=size**2 / (size**2).sum()):
        away = vector[row] / size[row] + rng.normal(0.0, ASKEW, 3)
        depth = float(np.exp(rng.uniform(*np.log(DEEP))))
        place = target[row] - depth * away / np.linalg.norm(away)
        values: dict[str, float | tuple[float, ...]] = {switch(effect).name: depth, solid.name: tuple(place.tolist())}
        result.append(effect.extension(**values))
    return result


def gathered(target: Target, trial: Trial, points: list[Array], share: float, rng: np.random.Generator) -> list[Start]:
    """Starts that save something, none twice: the points, and what CMA-ES finds from the best of them (Hansen and
    Ostermeier 2001). `share`: of all windows, those in the target.
    """
    if not points:
        return []
    space, null = trial.space, trial.space.start()
    before = float(target.losses(space, [null]).mean())
    tried = list(zip(target.losses(space, points).mean(axis=1).tolist(), points, strict=True))
    best = min(tried, key=lambda t: t[0])[1]
    lower, upper = (np.array(b) for b in space.bounds())
    sizes = np.ones(len(null))
    for a in trial.amplitudes:
        sizes[a] = max(1.0, STRONG * abs(best[a] - null[a]))
    options = {
        "bounds": [lower.tolist(), upper.tolist()], "popsize": CANDIDATES, "CMA_stds": sizes.tolist(),
        "seed": np.nan, "randn": lambda *shape: rng.standard_normal(shape), "verbose": -9,
    }  # fmt: skip
    strategy = cma.CMAEvolutionStrategy(np.clip(best, lower + INSIDE, upper - INSIDE), SPREAD, options)
    for _ in range(GENERATIONS):
        asked = [np.asarray(z) for z in strategy.ask()]
        losses = target.losses(space, asked).mean(axis=1).tolist()
        strategy.tell(asked, losses)
        tried += zip(losses, asked, strict=True)
    found: list[Start] = []
    for loss, z in sorted(tried, key=lambda t: t[0]):
        if loss < before and all(float(np.abs(z - s.z).max()) > APART for s in found):
            found.append(Start(z, share * (before - loss)))
    return found

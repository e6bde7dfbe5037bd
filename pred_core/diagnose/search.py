"""From a candidate to its best fit: where to start, a score that costs little, and the refinement."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from pred_core.diagnose.fit import Target, rho
from pred_core.diagnose.places import Start, first_values, gathered, solid_values
from pred_core.diagnose.trial import Trial, scanned, switch
from pred_core.effects import find_effect
from pred_core.identify.space import Candidate, SearchSpace
from pred_core.twin import Extension
from pred_core.types import Array

SECANT = 0.7  # typical changes of the switch, over which a first slope is taken
AHEAD = (1.5, 3.0, 6.0, 10.0)  # [typical changes] how far a start is followed along its direction
DECIDED = 1.5  # times what the start promises: then the search begins ahead of it only
NOWHERE = 1e-6  # [typical changes] length of a start that has no direction
PROMISING = 8  # places of those drawn that are tried in earnest
SCANNED = 16  # windows in which places are tried, those with the largest loss: one block of worlds


def starts(target: Target, trial: Trial, count: int, rng: np.random.Generator) -> list[Start]:
    """Starts of a trial, most promising first."""
    effects = [find_effect(i) for i in trial.ids]
    scanning = [e for e in effects if scanned(e)]
    space = trial.space
    if not trial.amplitudes:
        return [Start(space.start(), 0.0)]
    null = space.start()
    origins = [null]
    now = target.residuals(space, [null])
    if scanning and target.roller.sample.windows.count > SCANNED:  # where the error is, something can be found
        worst = rho(now[0]).sum(dim=(1, 2, 3)).argsort(descending=True)[:SCANNED].sort().values
        share = SCANNED / target.roller.sample.windows.count
        target, now = target.some(worst.numpy()), now[:, worst]
    else:
        share = 1.0
    solid: list[Array] = []
    if scanning:
        push = -(now[0] / target.weights[..., None].clamp_min(1e-9)).numpy()
        size = np.linalg.norm(push, axis=-1)
        drawn = [first_values(e, target.roller, size, count, rng) for e in scanning]
        origins = [_at(space, row) for row in zip(*drawn, strict=True)]
        solid = [_at(space, (v,), True) for e in scanning for v in solid_values(e, target.roller, push, count, rng)]
    upper = np.array(space.bounds()[1])
    lower = np.array(space.bounds()[0])
    points = []
    steps = []
    for origin in origins:
        for a in trial.amplitudes:
            step = SECANT if origin[a] + SECANT <= upper[a] else -SECANT
            point = origin.copy()
            point[a] = np.clip(origin[a] + step, lower[a], upper[a])
            points.append(point)
            steps.append(point[a] - origin[a])
    moved = target.residuals(space, points)
    found = []
    k = len(trial.amplitudes)
    for n, origin in enumerate(origins):
        g, h = _normal(target, now[0], moved[n * k : (n + 1) * k], np.array(steps[n * k : (n + 1) * k]))
        move = -np.linalg.solve(h + 1e-3 * np.diag(np.diag(h)) + 1e-9 * np.eye(k), g)
        z = origin.copy()
        amplitudes = list(trial.amplitudes)
        z[amplitudes] = np.clip(origin[amplitudes] + np.clip(move, -3.0, 3.0), lower[amplitudes], upper[amplitudes])
        actual = z[amplitudes] - origin[amplitudes]
        promise = -share * float(g @ actual + 0.5 * actual @ h @ actual)
        if scanning and not np.abs(actual).max() > 1e-6:
            continue
        found.append(Start(z, promise))
    found.sort(key=lambda s: -s.promise)
    if scanning:
        found = gathered(target, trial, [*solid, *(s.z for s in found[:PROMISING])], share, rng)
    ahead = _along(target, trial, found[0], share) if found else None
    if ahead is not None:
        decided = not scanning and ahead.promise > DECIDED * found[0].promise
        found = [ahead] if decided else sorted([ahead, *found], key=lambda s: -s.promise)
    return found or [Start(null, 0.0)]


def _along(target: Target, trial: Trial, start: Start, share: float) -> Start | None:
    """A better point farther along the direction of a start, None if there is none: where the loss bends, a straight
    line promises little, and a search that begins at a weak cause can end before it comes to a strong one.

    It is looked for in some of the windows; what it saves is measured in all of them.
    """
    space, switches = trial.space, list(trial.amplitudes)
    lower, upper = (np.array(b)[switches] for b in space.bounds())
    off = start.z.copy()
    off[switches] = space.start()[switches]
    length = float(np.linalg.norm(start.z - off))
    if length < NOWHERE:
        return None
    usual = target.roller.usual()
    count = target.roller.sample.windows.count
    few = target.some(np.linspace(0, count - 1, SCANNED).astype(np.int64)) if count > SCANNED else target
    best, least = start.z, float(few.losses(space, [start.z]).mean())
    for distance in (d for d in AHEAD if d > length):
        point = off + distance / length * (start.z - off)
        point[switches] = np.clip(point[switches], lower, upper)
        if np.array_equal(point, best) or target.roller.demand(space.candidate(point)) > trial.most * usual:
            break
        loss = float(few.losses(space, [point]).mean())
        if loss < least:
            best, least = point, loss
        elif best is not start.z:
            break  # it has passed the valley
    if best is start.z:
        return None
    before, after = target.losses(space, [off, best]).mean(axis=1)
    return Start(best, max(share * float(before - after), 0.0))


def _at(space: SearchSpace, values: Sequence[Extension], switched: bool = False) -> Array:
    """Coordinates with the scanned parameters of these values, and with their switches where they are on."""
    given = {}
    for extension in values:
        effect = find_effect(extension.id)
        names = [q.name for q in scanned(effect)] + ([switch(effect).name] if switched else [])
        given[extension.id] = {name: extension.parameters[name] for name in names}
    extensions = tuple(
        dataclasses.replace(e, parameters={**e.parameters, **given.get(e.id, {})}) for e in space.extensions
    )
    return coordinates(space, Candidate(space.physics, extensions))


def coordinates(space: SearchSpace, candidate: Candidate) -> Array:
    """Coordinates of a candidate's values."""
    values = {e.id: e.parameters for e in candidate.extensions}
    z = space.start()
    for n, knob in enumerate(space.knobs):
        if "." in knob.name:
            effect, rest = knob.name.split(".", 1)
            name, index = rest[:-1].split("[")
            z[n] = knob.coordinate(values[effect][name][int(index)])
        else:
            z[n] = knob.coordinate(float(getattr(candidate.physics, knob.name)))
    return z


def _normal(target: Target, now: torch.Tensor, moved: torch.Tensor, steps: Array) -> tuple[Array, Array]:
    """Gradient (k,) and curvature (k, k) of the mean loss along the switches."""
    slopes = (moved - now) / torch.as_tensor(steps, dtype=torch.float32).reshape(-1, 1, 1, 1, 1)
    soft = (1.0 + now.square()).rsqrt() * torch.as_tensor(target.counts(now), dtype=now.dtype)[:, None, None, None]
    g = target.per_episode(slopes * (now * soft)).mean(axis=1)
    k = len(steps)
    h = np.empty((k, k))
    for a in range(k):
        h[a] = target.per_episode(slopes * (slopes[a] * soft)).mean(axis=1)
    return g, h

"""The motion that would tell two causes apart: T-optimal design (Atkinson and Fedorov 1975) over a library of motions.

Both causes are rolled out over every motion; the best one has the largest distance
sum ||x_a - x_b||^2 / (sigma^2 + s^2), sigma the track noise and s^2 the spread of perturbed starts and base parameters,
after either cause has moved its strength within its interval to look like the other. The spread keeps motions away that
tell the causes apart only by luck: whips and coils, where anything small decides.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pred_core.diagnose.evidence import Judged
from pred_core.diagnose.motions import LONGEST, Limits, Motion, library, limits_of
from pred_core.diagnose.result import Diagnosis
from pred_core.diagnose.said import NAMES
from pred_core.diagnose.standing_start import SETTLE, Start, starts_of
from pred_core.diagnose.weigh import CHAOS, START
from pred_core.identify.space import Candidate
from pred_core.springmass import SpringMass
from pred_core.twin import Twin
from pred_core.types import Array, Episode, Grip, State

NEAR = 0.02  # probability of a runner-up from which it is a rival
WIDE = 1.0  # width of a 90 % interval over the value from which a single cause's strength is in question
DRAWS = 3  # perturbed starts
KNOWN = 0.05  # relative standard deviation of the base's parameters
UNSURE = ("stiffness", "ground_friction", "bending_stiffness")  # of them
NORMAL = 1.645  # standard deviations of half a 90 % interval
STEP = 0.05  # least coordinate step of a slope
SPACING = 0.05  # [s] between the points of the plan
THINNED = 2  # frames between those compared


@dataclass(frozen=True)
class Rival:
    """A cause with its values, and the same one standard deviation off in each of its strengths."""

    id: str
    family: str
    values: Mapping[str, float]
    candidate: Candidate
    shifted: tuple[tuple[Candidate, float], ...] = ()  # (point, standard deviations it is off)


def propose(answer: Diagnosis, episodes: Sequence[Episode], seed: int = 0) -> dict[str, Any] | None:
    """The motion to record next, as plain values (`motion_file`); None: nothing near enough to be told apart, or the
    grippers showed no motion to stay within.

    `episodes`: corrected as for the diagnosis. `answer`: complete but for its next motion.
    """
    pair = rivals_of(answer)
    mine = [e for e in episodes if e.split != "ood"]
    if pair is None or not mine or not mine[0].grips.position.shape[1]:
        return None
    found = choose(answer.base_twin, pair, mine, max(answer.gate.sigma, 1e-5), seed)
    return None if found is None else {**found, "rivals": [_plain(r) for r in pair]}


def rivals_of(answer: Diagnosis) -> tuple[Rival, Rival] | None:
    """The named cause and its strongest rival: of its group, else the runner-up, else itself at both ends of a wide
    interval; None: there is no rival."""
    named = {c.id: c for c in answer.causes if not c.measured}
    for number, seen in enumerate(answer.rounds):
        by_id = {j.trial.id: j for j, _, _ in seen.judged}
        chosen = next((j for j, _, why in seen.judged if not why and set(j.trial.ids) <= set(named)), None)
        if chosen is None:
            continue
        group = [g for g in named[chosen.trial.ids[0]].group if g in by_id]
        likely = [r.id for r in answer.ranking if r.probability >= NEAR and r.id in by_id] if number == 0 else []
        others = [i for i in (*group, *likely) if i != chosen.trial.id]
        if others:
            return _rival(chosen), _rival(by_id[others[0]])
        both = _ends(chosen)
        if both is not None:
            return both
    return None


def _rival(j: Judged) -> Rival:
    space, shifted = j.trial.space, []
    for n in j.trial.amplitudes:
        knob = space.knobs[n]
        low, high = (knob.coordinate(v) for v in j.intervals[knob.name])
        sd = abs(high - low) / 2.0 / NORMAL
        step = max(sd, STEP)
        z = j.z.copy()
        z[n] += step if knob.value(z[n] + step) != knob.value(z[n]) else -step
        shifted.append((space.candidate(z), step / max(sd, 1e-9)))
    return Rival(j.trial.id, j.trial.family, j.values, space.candidate(j.z), tuple(shifted))


def _ends(j: Judged) -> tuple[Rival, Rival] | None:
    """The cause at both ends of its widest strength's interval, if that is wide."""
    widths = {n: np.ptp(j.intervals[j.trial.space.knobs[n].name]) for n in j.trial.amplitudes}
    if not widths:
        return None
    n = max(widths, key=lambda k: widths[k])
    knob = j.trial.space.knobs[n]
    if widths[n] < WIDE * abs(j.values[knob.name] - j.null[knob.name]):
        return None
    ends = []
    for value in j.intervals[knob.name]:
        z = j.z.copy()
        z[n] = knob.coordinate(value)
        ends.append(Rival(j.trial.id, j.trial.family, j.trial.space.values(z), j.trial.space.candidate(z)))
    return ends[0], ends[1]


def choose(
    twin: Twin, pair: tuple[Rival, Rival], episodes: Sequence[Episode], sigma: float, seed: int
) -> dict[str, Any] | None:
    """The best motion of the library for two rivals, as plain values. `sigma` [m] noise of the tracks."""
    starts = starts_of(twin, episodes)
    motions: list[Motion] = []
    limits = []
    for home, start in enumerate(starts):
        limits.append(limits_of([e for e in episodes if e.name in start.like]))
        motions += library(start.grip, home, limits[home], twin.meta.period, start.axis, start.over, start.touches)
    if not any(not m.name.startswith("rest") for m in motions):
        return None
    generator = torch.Generator().manual_seed(seed)
    a, b = (roll(twin, r, starts, motions, sigma, generator.manual_seed(seed)) for r in pair)
    free = starts[0].state.held < 0
    distances, remaining = separation(a, b, sigma, free)
    best = int(distances.argmax())
    return _told(twin, motions, best, distances, remaining, a, b, pair, starts, limits, free)


@dataclass(frozen=True)
class Rolled:
    """One rival over all motions."""

    position: Tensor  # (M, K, N, 3) [m]
    slopes: Tensor  # (P, M, K, N, 3) [m] a standard deviation of each strength
    spread: Tensor  # (M, K, N) [m^2] of perturbed starts and base parameters, a coordinate


def roll(
    twin: Twin, rival: Rival, starts: Sequence[Start], motions: Sequence[Motion], sigma: float, generator: torch.Generator
) -> Rolled:
    """The rival, itself with shifted strengths, and perturbed, each settled where the motion begins."""
    shaken = [_shaken(rival.candidate, generator) for _ in range(DRAWS)]
    points = [rival.candidate, *(c for c, _ in rival.shifted), *shaken]
    homes, count = len(starts), len(motions)
    settled = _settled(twin, points, starts)
    home = torch.tensor([p * homes + m.home for p in range(len(points)) for m in motions])
    state = State(settled.position[home], settled.velocity[home], settled.held[home],
                  {k: v[home] for k, v in settled.memory.items()})  # fmt: skip
    loose = (state.held < 0)[..., None].clone()
    loose[: (len(points) - DRAWS) * count] = False
    noise = [torch.randn(state.position.shape, generator=generator) * loose * START * sigma for _ in range(2)]
    state = state.replace(position=state.position + noise[0], velocity=state.velocity + 0.3 * noise[1] / twin.meta.period)
    grips = [torch.as_tensor(np.stack([v for v in column], axis=1)).float().repeat(1, len(points), 1, 1)
             for column in ([m.position for m in motions], [m.rotation for m in motions])]  # fmt: skip
    closed = starts[0].grip.closed.expand(*grips[0].shape[:-1])
    simulator = _simulator(twin, points, count)
    raw = simulator.rollout(state, Grip(grips[0], grips[1], closed))[THINNED - 1 :: THINNED]
    x = raw.unflatten(1, (len(points), count)).permute(1, 2, 0, 3, 4)  # (points, M, K, N, 3)
    strengths = len(rival.shifted)
    scale = torch.tensor([s for _, s in rival.shifted]).reshape(-1, 1, 1, 1, 1)
    spread = (x[1 + strengths :] - x[0]).square().mean(dim=(0, -1))
    return Rolled(x[0], (x[1 : 1 + strengths] - x[0]) / scale, spread)


def _shaken(candidate: Candidate, generator: torch.Generator) -> Candidate:
    """With the base's parameters off by what is not known of them."""
    factor = torch.exp(KNOWN * torch.randn(len(UNSURE), generator=generator)).tolist()
    values = {name: getattr(candidate.physics, name) * f for name, f in zip(UNSURE, factor, strict=True)}
    return dataclasses.replace(candidate, physics=dataclasses.replace(candidate.physics, **values))


def _settled(twin: Twin, points: Sequence[Candidate], starts: Sequence[Start]) -> State:
    """Each point at each start, at rest after SETTLE with the grippers still."""
    many = len(points)
    state = State(*(torch.cat([getattr(s.state, f)[None] for s in starts] * many) for f in ("position", "velocity", "held")))
    grip = Grip(*(torch.cat([getattr(s.grip, f)[None] for s in starts] * many) for f in ("position", "rotation", "closed")))
    simulator = _simulator(twin, points, len(starts))
    begun = simulator.start(state, grip)
    memory = {**begun.memory, "time": torch.full_like(begun.memory["time"], max(s.session for s in starts))}
    frames = max(1, round(SETTLE / twin.meta.period))
    still = Grip(*(v[None].expand(frames, *v.shape) for v in (grip.position, grip.rotation, grip.closed)))
    return simulator.rollout_states(begun.replace(memory=memory), still)[1]


def _simulator(twin: Twin, points: Sequence[Candidate], each: int) -> SpringMass:
    extended = any(p.extensions for p in points)
    return SpringMass(
        twin.body,
        [p.physics for p in points for _ in range(each)],
        twin.scene,
        period=twin.meta.period,
        extensions=[p.extensions for p in points for _ in range(each)] if extended else (),
        diverged_as_nan=True,
    )


def separation(a: Rolled, b: Rolled, sigma: float, free: Tensor) -> tuple[Array, Array]:
    """(M,) distances in standard deviations squared, and (M, K, N, 3) [m] what remains of the difference after the
    strengths have moved. A motion over which either diverges has distance 0.
    """
    d = (a.position - b.position).double()
    usable = d.flatten(1).isfinite().all(dim=1)
    spread = 0.5 * (a.spread + b.spread).double()
    variance = sigma**2 + CHAOS * torch.where(spread.isfinite(), spread, torch.inf)  # what may diverge tells nothing
    weight = (free.double() / variance)[..., None]  # (M, K, N, 1)
    slopes = torch.cat((-a.slopes, b.slopes)).double()  # moving either: d + slopes . delta
    distances, remaining = np.zeros(len(d)), np.zeros(d.shape)
    for m in range(len(d)):
        if not usable[m]:
            continue
        j = slopes[:, m].flatten(1)
        w = weight[m].expand(d[m].shape).flatten()
        left = d[m].flatten()
        if len(j) and bool(j.isfinite().all()):
            h = (j * w) @ j.T + torch.eye(len(j), dtype=torch.float64)
            delta = -torch.linalg.solve(h, (j * w) @ left)
            left = left + delta @ j
            distances[m] = float((w * left.square()).sum() + delta.square().sum())
        else:
            distances[m] = float((w * left.square()).sum())
        remaining[m] = left.reshape(d[m].shape).numpy()
    return distances, remaining


def _told(
    twin: Twin,
    motions: Sequence[Motion],
    best: int,
    distances: Array,
    remaining: Array,
    a: Rolled,
    b: Rolled,
    pair: tuple[Rival, Rival],
    starts: Sequence[Start],
    limits: Sequence[Limits],
    free: Tensor,
) -> dict[str, Any]:
    motion = motions[best]
    start, bound = starts[motion.home], limits[motion.home]
    apart = 1e3 * np.linalg.norm(remaining[:, :, free.numpy()], axis=-1)  # (M, K, free) [mm]
    mean = np.sqrt((apart**2).mean(axis=(1, 2)))
    widest = int(apart[best].mean(axis=-1).argmax())
    order = np.argsort(-distances)
    names = [NAMES.get(r.id, r.id) for r in pair]
    if pair[0].id == pair[1].id:
        names = [f"{n} at the {end} end of its interval" for n, end in zip(names, ("lower", "upper"), strict=True)]
    middle = float(np.median(mean))
    return {
        "name": motion.name,
        "why": f"{names[0]} and {names[1]} move the object {mean[best]:.1f} mm apart in it (root mean square over free "
        f"particles and {LONGEST:g} s, after either has taken the strength that looks most like the other), "
        f"{np.sqrt(distances[best]):.0f} standard deviations in all; the median of {len(motions)} motions tried "
        f"tells {middle:.1f} mm",
        "distance_mm": float(mean[best]),
        "distance_sigma": float(np.sqrt(distances[best])),
        "tried": [
            {"name": motions[k].name, "distance_mm": float(mean[k]), "distance_sigma": float(np.sqrt(distances[k]))}
            for k in order
        ],
        "start": {"episode": start.episode, "frame": start.frame, "rest_first": SETTLE, "on_table": start.touches},
        "limits": {"low": bound.low.tolist(), "high": bound.high.tolist(), "speed": bound.speed,
                   "acceleration": bound.acceleration, "turn_speed": bound.turn_speed},
        "widest": {
            "time": (widest + 1) * THINNED * twin.meta.period,
            "shapes": [r.position[best, widest].tolist() for r in (a, b)],
        },
        "trajectory": trajectory(motion, start.grip, twin.meta.period),
    }  # fmt: skip


def trajectory(motion: Motion, start: Grip, period: float) -> dict[str, Any]:
    """The motion as a trajectory_msgs/MultiDOFJointTrajectory in plain values, from the start pose at 0 s.

    Its last two points are the same pose: who follows it may wait there.
    """
    position = np.concatenate((start.position.double().numpy()[None], motion.position))
    rotation = np.concatenate((start.rotation.double().numpy()[None], motion.rotation))
    stride = max(1, round(SPACING / period))
    kept = [*range(0, len(position) - 1, stride), len(position) - 1]
    times = [period * k for k in kept]
    kept, times = [*kept, kept[-1]], [*times, times[-1] + period * stride]
    return {
        "frame_id": "world",
        "joint_names": [f"gripper{g}" for g in range(position.shape[1])],
        "points": [
            {
                "time_from_start": t,
                "transforms": [
                    {"translation": position[k, g].tolist(), "rotation": rotation[k, g].tolist()}
                    for g in range(position.shape[1])
                ],
            }
            for t, k in zip(times, kept, strict=True)
        ],
    }


def _plain(r: Rival) -> dict[str, Any]:
    return {"id": r.id, "family": r.family, "values": dict(r.values)}

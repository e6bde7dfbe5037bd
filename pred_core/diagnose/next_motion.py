"""The motion that would tell two causes apart: T-optimal design (Atkinson and Fedorov 1975) over a library of motions.

Both causes are rolled out over every motion; the best one has the largest distance
sum ||x_a - x_b||^2 / (sigma^2 + s^2), sigma the track noise and s^2 the spread of perturbed starts and base parameters,
after either cause has moved its strength within its interval to look like the other. The spread keeps motions away that
tell the causes apart only by luck: whips and coils, where anything small decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pred_core.arm.plan_needs import needs_of
from pred_core.diagnose.apart import THINNED, Rival, Rolled, Separation, roll, separation
from pred_core.diagnose.chosen import chosen_of
from pred_core.diagnose.evidence import Judged
from pred_core.diagnose.motions import LONGEST, Limits, Motion, library, limits_of
from pred_core.diagnose.result import Diagnosis
from pred_core.diagnose.said import NAMES
from pred_core.diagnose.standing_start import SETTLE, Start, starts_of
from pred_core.twin import Twin
from pred_core.types import Array, Episode, Grip

TELLS = 3.0  # standard deviations that two rivals must be apart in a motion, for it to be proposed
NEAR = 0.02  # probability of a runner-up from which it is a rival
WIDE = 1.0  # width of a 90 % interval over the value from which a single cause's strength is in question
NORMAL = 1.645  # standard deviations of half a 90 % interval
STEP = 0.05  # least coordinate step of a slope
SPACING = 0.05  # [s] between the points of the plan
DIGITS = 7  # after the point, of its numbers


def propose(answer: Diagnosis, episodes: Sequence[Episode], seed: int = 0) -> dict[str, Any] | None:
    """The motion to record next, as plain values (`motion_file`); None: nothing near enough to be told apart, or the
    grippers showed no motion to stay within.

    `episodes`: corrected as for the diagnosis. `answer`: complete but for its next motion.
    """
    pair = rivals_of(answer)
    mine = [e for e in episodes if e.split != "ood"]
    if pair is None or not mine or not mine[0].grips.position.shape[1]:
        return None
    return choose(answer.twin, pair, mine, max(answer.gate.sigma, 1e-5), seed)


def rivals_of(answer: Diagnosis) -> tuple[Rival, Rival] | None:
    """The named cause and its strongest rival: of its group, else the runner-up, else itself at both ends of a wide
    interval; None: there is no rival."""
    named = {c.id: c for c in answer.causes}
    for number, (seen, chosen) in enumerate(zip(answer.rounds, chosen_of(answer.rounds, answer.causes), strict=True)):
        if chosen is None:
            continue
        by_id = {j.trial.id: j for j, _, _ in seen.judged}
        group = named[chosen.trial.ids[0]].group
        likely = [r.id for r in answer.ranking if r.probability >= NEAR] if number == 0 else []
        others = [i for i in (*group, *likely) if i in by_id and i != chosen.trial.id]
        pair = (_rival(chosen), _rival(by_id[others[0]])) if others else _ends(chosen)
        if pair is not None:
            return pair
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


@dataclass(frozen=True)
class Tried:
    """All motions of the library with what two rivals do in them."""

    motions: tuple[Motion, ...]
    starts: tuple[Start, ...]
    limits: tuple[Limits, ...]  # of each start
    first: Rolled
    second: Rolled
    separation: Separation

    @property
    def apart(self) -> Array:
        """(M, K, F) [mm] between the rivals' free particles."""
        free = (self.starts[0].state.held < 0).numpy()
        return np.asarray(1e3 * np.linalg.norm(self.separation.remaining[:, :, free], axis=-1))


def choose(
    twin: Twin, pair: tuple[Rival, Rival], episodes: Sequence[Episode], sigma: float, seed: int
) -> dict[str, Any] | None:
    """The best motion of the library for two rivals, as plain values; None: no room to move, or no motion tells.

    `sigma` [m] noise of the tracks.
    """
    tried = compare(twin, pair, episodes, sigma, seed)
    if tried is None or tried.separation.squared.max() < TELLS**2:
        return None
    return _told(twin, pair, tried)


def compare(
    twin: Twin, pair: tuple[Rival, Rival], episodes: Sequence[Episode], sigma: float, seed: int
) -> Tried | None:
    """Both rivals over every motion of the library; None: there is no room to move."""
    starts = starts_of(twin, episodes)
    limits = [limits_of([e for e in episodes if e.name in s.like]) for s in starts]
    motions: list[Motion] = []
    for home, (s, bound) in enumerate(zip(starts, limits, strict=True)):
        motions += library(s.grip, home, bound, twin.meta.period, s.axis, s.over, s.touches)
    if len(motions) == len(starts):  # only rest
        return None
    first, second = (roll(twin, r, starts, motions, sigma, torch.Generator().manual_seed(seed)) for r in pair)
    both = separation(first, second, sigma, starts[0].state.held < 0)
    return Tried(tuple(motions), tuple(starts), tuple(limits), first, second, both)


def _told(twin: Twin, pair: tuple[Rival, Rival], tried: Tried) -> dict[str, Any]:
    """The best motion and how the others do."""
    order = np.argsort(-tried.separation.squared)
    best, apart = int(order[0]), tried.apart
    mean, sds = np.sqrt((apart**2).mean(axis=(1, 2))), np.sqrt(tried.separation.squared)
    motion = tried.motions[best]
    start, bound = tried.starts[motion.home], tried.limits[motion.home]
    widest = int(apart[best].mean(axis=-1).argmax())
    names = [NAMES.get(r.id, r.id.replace("_", " ")) for r in pair]
    if pair[0].id == pair[1].id:
        names = [f"{n} at the {end} end of its interval" for n, end in zip(names, ("lower", "upper"), strict=True)]
    why = (
        f"{names[0]} and {names[1]} are {mean[best]:.1f} mm apart in it (root mean square over free particles and "
        f"{LONGEST:g} s, after either has taken the strength that looks most like the other), {sds[best]:.0f} standard "
        f"deviations in all; in the median of the {len(tried.motions)} motions tried, {float(np.median(mean)):.1f} mm"
    )
    followed = trajectory(motion, start.grip, twin.meta.period)
    return {
        "name": motion.name,
        "why": why[0].upper() + why[1:],
        "distance_mm": float(mean[best]),
        "distance_sigma": float(sds[best]),
        "tried": [
            {"name": tried.motions[k].name, "distance_mm": float(mean[k]), "distance_sigma": float(sds[k])}
            for k in order
        ],
        "rivals": [{"id": r.id, "family": r.family, "values": dict(r.values)} for r in pair],
        "start": {"episode": start.episode, "frame": start.frame, "rest_first": SETTLE, "on_table": start.touches},
        "limits": {
            "low": bound.low.tolist(),
            "high": bound.high.tolist(),
            "speed": bound.speed,
            "acceleration": bound.acceleration,
            "turn_speed": bound.turn_speed,
        },
        "widest": {
            "time": (widest + 1) * THINNED * twin.meta.period,
            "shapes": [r.position[best, widest].tolist() for r in (tried.first, tried.second)],
        },
        "arm": arm_needs(followed),
        "trajectory": followed,
    }


def arm_needs(trajectory: Mapping[str, Any]) -> dict[str, float]:
    """Parameters of the arm node that every gripper's way needs at least."""
    points = trajectory["points"]
    times = np.array([p["time_from_start"] for p in points])
    rows = []
    for g in range(len(trajectory["joint_names"])):
        position = np.array([p["transforms"][g]["translation"] for p in points])
        rotation = np.array([p["transforms"][g]["rotation"] for p in points])
        rows.append(needs_of(times, position, rotation))
    return {name: max(r[name] for r in rows) for name in rows[0]}


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
                "time_from_start": round(t, DIGITS),
                "transforms": [
                    {"translation": position[k, g].round(DIGITS).tolist(),
                     "rotation": rotation[k, g].round(DIGITS).tolist()}
                    for g in range(position.shape[1])
                ],
            }
            for t, k in zip(times, kept, strict=True)
        ],
    }

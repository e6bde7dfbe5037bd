"""A small library of safe, smooth gripper motions: inside the box the grippers visited, no faster than they were.

Every motion starts at a measured pose of the grippers and ends at rest. It is a path over a phase 0..1, given in time
so that its peak speed, turning rate and acceleration are a share of what the recordings showed: a path of peak speed
v over one second has v / T over T seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.frames import (
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_to_rotation_vector,
)
from pred_core.types import Array, Episode, Grip

LAG = 2  # frames to either side of a velocity
USUAL = 0.99  # quantile of what was shown that counts as its largest
MOST = (1.0, 10.0, 3.0)  # [m/s], [m/s^2], [rad/s] whatever was shown: a hand may be faster than an arm should be
FAST, SLOW = 0.95, 0.3  # shares of the speed limit
SHORTEST, LONGEST = 0.6, 6.0  # [s] of a motion; LONGEST is how long each is watched
REST = 0.5  # [s] at least of the watching after the motion has ended
FARTHEST = 0.25  # [m] from the start
TURN = 0.8  # [rad] from the start
ROTATED = 2  # grippers; more are points of rigid ends, which cannot turn by themselves
LEAST = 0.01  # [m], [rad] of a motion that is worth trying
FINE = 400  # samples of a path in which its peaks are looked for

Path = Callable[[Array], tuple[Array, Array]]  # phase (K,) -> shift (K, 3) [m], rotation vector (K, 3) [rad], world


@dataclass(frozen=True)
class Limits:
    """What the grippers showed."""

    low: Array  # (G, 3) [m] of the visited box
    high: Array  # (G, 3) [m]
    speed: float  # [m/s]
    acceleration: float  # [m/s^2]
    turn_speed: float  # [rad/s]
    turn: float  # [rad] largest rotation from where an episode begins


@dataclass(frozen=True)
class Motion:
    """Poses of all grippers over time."""

    name: str
    home: int  # which of the starts it begins at
    position: Array  # (T, G, 3) [m] world; T frames after the start, the first at one period
    rotation: Array  # (T, G, 4) wxyz


def limits_of(episodes: Sequence[Episode]) -> Limits:
    """Box, speeds and turns over all frames of these episodes, speeds and accelerations up to MOST."""
    places, speeds, accelerations, rates, turns = [], [0.0], [0.0], [0.0], [0.0]
    for e in episodes:
        p, q = e.grips.position.double(), e.grips.rotation.double()
        places.append(p.numpy())
        t = torch.as_tensor(e.stamps - e.stamps[0]).double() * 1e-9
        turned = quaternion_to_rotation_vector(quaternion_multiply(quaternion_conjugate(q[:1]), q)).norm(dim=-1)
        turns.append(float(turned.max()) if turned.numel() else 0.0)
        if len(t) <= 4 * LAG or not p.shape[1]:
            continue
        wide = 2 * LAG
        seconds = (t[wide:] - t[:-wide])[:, None]
        velocity = (p[wide:] - p[:-wide]) / seconds[..., None]
        rate = quaternion_to_rotation_vector(quaternion_multiply(quaternion_conjugate(q[:-wide]), q[wide:]))
        between = (velocity[wide:] - velocity[:-wide]) / seconds[wide:][..., None]
        speeds.append(float(torch.quantile(velocity.norm(dim=-1), USUAL)))
        rates.append(float(torch.quantile(rate.norm(dim=-1) / seconds, USUAL)))
        accelerations.append(float(torch.quantile(between.norm(dim=-1), USUAL)))
    every = np.concatenate(places)
    fast, sharp, turning = (min(max(v), m) for v, m in zip((speeds, accelerations, rates), MOST, strict=True))
    return Limits(every.min(axis=0), every.max(axis=0), fast, sharp, turning, max(turns))


def library(
    grip: Grip, home: int, limits: Limits, period: float, grip_axis: Array, over: Array, table: bool
) -> list[Motion]:
    """Motions from the pose `grip` (G, ...). `grip_axis` (3,): the object's direction where it is held; `over` (3,):
    horizontal direction from the grippers to the object's middle; `table`: the object lies on a table there.
    """
    p = grip.position.double().numpy()
    up, down = limits.high - p, limits.low - p  # (G, 3) room to either side

    def room(direction: Array) -> float:
        """[m] the grippers can go that way."""
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.where(direction > 1e-9, up / direction, np.where(direction < -1e-9, down / direction, np.inf))
        return float(np.clip(far.min(initial=FARTHEST), 0.0, FARTHEST))

    x, y, z = np.eye(3)
    angle = min(limits.turn, TURN)
    rows: list[tuple[str, list[tuple[Path, float]]]] = [("rest", [])]
    for name, axis in (("x", x), ("y", y)):
        far = min(room(axis), room(-axis))
        rows.append((f"swing along {name}, fast", [(_swing(far * axis, 3), FAST)]))
        rows.append((f"swing along {name}, slow", [(_swing(far * axis, 1), SLOW)]))
        way = axis if room(axis) >= room(-axis) else -axis
        rows.append((f"step along {name}, then hold", [(_move(room(way) * way), FAST)]))
    for sign, name, axis in ((1, "+x", x), (-1, "-x", x), (1, "+y", y), (-1, "-y", y)):
        way = sign * axis
        rows.append((f"{'drag' if table else 'carry'} along {name}, slow", [(_move(room(way) * way), SLOW)]))
    if len(p) == 1:
        rows.append(("U-bend, slowly back over the object", [(_move(room(over) * over), SLOW)]))
    way = z if room(z) >= room(-z) else -z
    rows.append(("lift and lower, slow", [(_there_and_back(room(way) * way), SLOW)]))
    ring = 0.5 * min(room(x), room(-x), room(y), room(-y))
    rows.append(("the same ring slow and fast", [(_ring(ring), SLOW), (_ring(ring), FAST)]))
    if len(p) <= ROTATED:
        rows.append(("hang still at three yaws", [(_turns(angle * z), FAST)]))
        rows.append(("pure roll", [(_there_and_back(np.zeros(3), angle * grip_axis), FAST)]))
    where = "on the table" if table else "in the air"
    made = [_motion(f"{name}, {where}", home, legs, grip, limits, period) for name, legs in rows]
    if len(p) > 1:
        made.append(_gathered(f"U-bend, the ends slowly together, {where}", home, grip, limits, period))
    return [m for m in made if m is not None]


def _gathered(name: str, home: int, grip: Grip, limits: Limits, period: float) -> Motion | None:
    """The grippers of the far end go towards the first one, as far as their boxes and half of the way allow."""
    p = grip.position.double().numpy()
    away = np.linalg.norm(p - p[0], axis=1)
    end = int(away.argmax())
    moves = np.linalg.norm(p - p[end], axis=1) < away
    way = p[0] - p[end]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(way > 1e-9, (limits.high - p) / way, np.where(way < -1e-9, (limits.low - p) / way, np.inf))
    least = float(np.clip(share[moves].min(initial=0.5), 0.0, 0.5))
    return _motion(name, home, [(_move(least * way), SLOW)], grip, limits, period, moves)


def _motion(
    name: str,
    home: int,
    legs: list[tuple[Path, float]],
    grip: Grip,
    limits: Limits,
    period: float,
    moves: NDArray[np.bool_] | None = None,
) -> Motion | None:
    """The legs one after the other, then at rest until LONGEST; None: too small to be worth it. moves (G,): which
    grippers; None: all.
    """
    frames = round(LONGEST / period)
    shift, turn = np.zeros((frames, 3)), np.zeros((frames, 3))
    times, begin = period * np.arange(1, frames + 1), 0.0
    budget = (LONGEST - REST) / max(len(legs), 1)
    for path, share in legs:
        size, seconds = _paced(path, share, limits, budget)
        if size == 0.0:
            return None
        phase = np.clip((times - begin) / seconds, 0.0, 1.0)
        ahead = times > begin
        moved, turned = path(phase)
        shift[ahead], turn[ahead] = shift[ahead] + size * moved[ahead], turn[ahead] + size * turned[ahead]
        begin += seconds
    q = quaternion_from_rotation_vector(torch.as_tensor(turn))[:, None]
    rotation = quaternion_multiply(q, grip.rotation.double()[None])
    who = np.ones(len(grip.position)) if moves is None else moves.astype(float)
    return Motion(name, home, grip.position.double().numpy()[None] + who[:, None] * shift[:, None], rotation.numpy())


def _paced(path: Path, share: float, limits: Limits, longest: float) -> tuple[float, float]:
    """(size of the path as a share, seconds) so that no limit is passed; size 0: not worth trying."""
    moved, turned = path(np.linspace(0.0, 1.0, FINE))
    if max(np.linalg.norm(moved, axis=1).max(), np.linalg.norm(turned, axis=1).max()) < LEAST:
        return 0.0, 0.0
    step = 1.0 / (FINE - 1)
    speed = float(np.linalg.norm(np.diff(moved, axis=0), axis=1).max()) / step
    acceleration = float(np.linalg.norm(np.diff(moved, 2, axis=0), axis=1).max()) / step**2
    rate = float(np.linalg.norm(np.diff(turned, axis=0), axis=1).max()) / step
    if (speed > 0.0 and min(limits.speed, limits.acceleration) <= 0.0) or (rate > 0.0 and limits.turn_speed <= 0.0):
        return 0.0, 0.0
    linear = speed / (share * limits.speed) if speed > 0.0 else 0.0
    angular = rate / (share * limits.turn_speed) if rate > 0.0 else 0.0
    gentle = float(np.sqrt(acceleration / limits.acceleration)) if acceleration > 0.0 else 0.0
    seconds = max(linear, angular, gentle, SHORTEST)
    size = min(1.0, longest / max(linear, angular, 1e-9), (longest / gentle) ** 2 if gentle > 0.0 else 1.0)
    far = size * max(np.linalg.norm(moved, axis=1).max(), np.linalg.norm(turned, axis=1).max())
    return (size, min(seconds, longest)) if far >= LEAST else (0.0, 0.0)


def smooth(s: Array) -> Array:
    """0 before 0, 1 after 1, at rest at both (minimum jerk, Flash and Hogan 1985)."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def _move(shift: Array, turn: Array | None = None) -> Path:
    turned = np.zeros(3) if turn is None else turn
    return lambda s: (smooth(s)[:, None] * shift, smooth(s)[:, None] * turned)


def _there_and_back(shift: Array, turn: Array | None = None) -> Path:
    turned = np.zeros(3) if turn is None else turn

    def path(s: Array) -> tuple[Array, Array]:
        way = (smooth(2.0 * s) - smooth(2.0 * s - 1.0))[:, None]
        return way * shift, way * turned

    return path


def _swing(shift: Array, cycles: int) -> Path:
    def path(s: Array) -> tuple[Array, Array]:
        fade = smooth(4.0 * s) * smooth(4.0 * (1.0 - s))
        way = (fade * np.sin(2.0 * np.pi * cycles * s))[:, None]
        return way * shift, np.zeros((len(s), 3))

    return path


def _ring(radius: float) -> Path:
    def path(s: Array) -> tuple[Array, Array]:
        angle = 2.0 * np.pi * smooth(s)
        way = radius * np.stack((1.0 - np.cos(angle), np.sin(angle), np.zeros_like(s)), axis=1)
        return way, np.zeros_like(way)

    return path


def _turns(turn: Array) -> Path:
    """To one side, to the other, and back, with holds between."""

    def path(s: Array) -> tuple[Array, Array]:
        way = (smooth(6.0 * s) - 2.0 * smooth(6.0 * s - 2.5) + smooth(6.0 * s - 5.0))[:, None]
        return np.zeros((len(s), 3)), way * turn

    return path

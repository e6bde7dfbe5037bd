"""Follows timed gripper poses: a plan is taken whole or refused with one line, then sampled at any time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.arm.limits import MOST_LIFETIME, GuardConfig, workspace_of
from pred_core.arm.orientation import Quaternion, angle_between, conjugate, multiply, slerp
from pred_core.errors import InputError

Array = NDArray[np.float64]
NS = 1e9
WORLD = "world"
UNIT_TOLERANCE = 1e-3  # of a quaternion's norm, as in the bag contract
OVER = 1.5  # a plan may ask for this times the speed limit between two points; the guard lags behind it
REST = 1e-6  # [m], [rad] between the last two points of a plan that ends at rest
OUTSIDE = 0.005  # [m] a plan may leave the workspace by, as a measured beginning may; the guard keeps the arm inside
MOST_WAITING = 100  # plans not yet begun
MOST_POINTS = 5_000  # of a plan: more would keep the arm waiting while it is read
FARTHEST = 10.0  # [m] from the origin of `world`, in a robot's reach


@dataclass(frozen=True)
class Plan:
    """Poses of one gripper over time, in `world`."""

    start: int  # [ns]
    times: Array  # (K,) [s] after start, increasing
    position: Array  # (K, 3) [m]
    rotation: Array  # (K, 4) wxyz, unit

    @property
    def begin(self) -> int:
        """Of the first point [ns]."""
        return self.start + round(float(self.times[0]) * NS)

    @property
    def end(self) -> int:
        """Of the last point [ns]."""
        return self.start + round(float(self.times[-1]) * NS)

    @property
    def ends_at_rest(self) -> bool:
        """The last two points are the same pose: the arm may wait there."""
        still = float(np.linalg.norm(self.position[-1] - self.position[-2])) <= REST
        return still and angle_between(_wxyz(self.rotation[-2]), _wxyz(self.rotation[-1])) <= REST

    def at(self, time: int) -> tuple[Array, Quaternion]:
        """The pose at `time` [ns]: linear in position, slerp in rotation; the first and last one beyond the ends."""
        seconds = (time - self.start) / NS
        k = int(np.clip(np.searchsorted(self.times, seconds, side="right") - 1, 0, len(self.times) - 2))
        share = float(np.clip((seconds - self.times[k]) / (self.times[k + 1] - self.times[k]), 0.0, 1.0))
        position = self.position[k] + share * (self.position[k + 1] - self.position[k])
        return position, slerp(_wxyz(self.rotation[k]), _wxyz(self.rotation[k + 1]), share)


def make_plan(
    start: int, frame: str, times: Sequence[float], position: Array, rotation: Array, config: GuardConfig
) -> Plan:
    """A plan that can be followed.

    Args: start [ns]; frame of the poses; times (K,) [s]; position (K, 3) [m]; rotation (K, 4) wxyz.
    Raises: InputError as `checked_poses`, or for a jump between two points, or one outside the workspace.
    """
    moments, position, rotation = checked_poses(frame, times, position, rotation)
    plan = Plan(start, moments, position, rotation)
    _check_jumps(plan, config)
    _check_place(plan, config)
    return plan


def checked_poses(
    frame: str, times: Sequence[float], position: Array, rotation: Array
) -> tuple[Array, Array, Array]:
    """Timed poses that some arm could follow, quaternions normed.

    Raises: InputError for another frame than world, fewer than two points or too many, times that do not increase,
    values that are not finite, places out of any arm's reach, or quaternions without unit norm.
    """
    if frame != WORLD:
        raise InputError("plan is in another frame", got=repr(frame), allowed=repr(WORLD))
    moments = np.asarray(times, float)
    if len(moments) < 2:
        raise InputError("plan has too few points", got=len(moments), allowed="2 or more")
    if len(moments) > MOST_POINTS:
        raise InputError(
            "plan has too many points", got=f"{len(moments):,}", allowed=f"{MOST_POINTS:,}",
            next_step="Send it in parts, or with points farther apart",
        )  # fmt: skip
    if position.shape != (len(moments), 3) or rotation.shape != (len(moments), 4):
        raise InputError("plan", got=f"shapes {position.shape} and {rotation.shape}", allowed="one pose per point")
    if not (np.isfinite(moments).all() and np.isfinite(position).all() and np.isfinite(rotation).all()):
        raise InputError("plan has a value that is not finite")
    far = np.abs(position).max(axis=1)
    if (far > FARTHEST).any():
        k = int(far.argmax())
        raise InputError(
            f"plan is out of reach at point {k}", got=f"{np.round(position[k], 4).tolist()} m",
            allowed=f"{FARTHEST:g} m from the origin", next_step="Positions are in metres",
        )  # fmt: skip
    falls = np.diff(np.concatenate(([-np.inf], moments))) <= 0.0
    falls[0] = moments[0] < 0.0
    if falls.any():
        k = int(falls.argmax())
        found = np.round(moments[max(k - 1, 0) : k + 1], 4).tolist()
        raise InputError(f"plan's times do not increase from 0 at point {k}", got=found)
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(rotation, axis=-1)
    if not (np.abs(norm - 1.0) <= UNIT_TOLERANCE).all():
        k = int(np.argmax(~(np.abs(norm - 1.0) <= UNIT_TOLERANCE)))
        raise InputError(
            f"plan has a quaternion without unit norm at point {k}", got=float(norm[k]), allowed="1 +- 0.001"
        )
    return moments, np.asarray(position, float), rotation / norm[:, None]


class Follower:
    """Holds the plan in force and those whose first point is not due yet.

    A planner may send plans faster than they begin; each begins where the one before will have brought the arm.
    """

    def __init__(self, config: GuardConfig, lifetime: float):
        self._config = config
        self._lifetime = lifetime  # [s] after its stamp a plan is followed no more; it begins no further ahead
        self._plan: Plan | None = None
        self._waiting: list[Plan] = []  # by their beginning

    @property
    def plan(self) -> Plan | None:
        """The plan in force."""
        return self._plan

    def clear(self) -> None:
        """Forget every plan."""
        self._plan, self._waiting = None, []

    def accept(self, plan: Plan, here: tuple[Array, Quaternion], now: int) -> None:
        """Follow a plan from its first point on, instead of those that would begin later. `here`: the present
        set-point, `now` [ns].

        Raises: InputError for a plan that is over, too long to be followed to its end, begins too far ahead or where
        the arm cannot be by then, or is one too many.
        """
        if plan.end <= now:
            raise InputError("plan lies in the past", got=f"it ended {(now - plan.end) / NS:.3f} s ago")
        length = (plan.end - plan.start) / NS
        if length > self._lifetime:  # it would be cut off on the way
            longer = f", or start the arm with -p lifetime:={math.ceil(length)}.0" if length <= MOST_LIFETIME else ""
            raise InputError(
                "plan is too long",
                got=f"{length:.3f} s from its stamp to its end",
                allowed=f"{self._lifetime:g} s",
                next_step=f"Send it in parts{longer}",
            )
        if plan.begin - now > self._lifetime * NS:
            raise InputError(
                "plan begins too far ahead",
                got=f"{(plan.begin - now) / NS:.3f} s",
                allowed=f"{self._lifetime:g} s",
                next_step="Check the planner's clock",
            )
        due = max(now, plan.begin)
        sooner = [p for p in self._waiting if p.begin < plan.begin]
        if len(sooner) == MOST_WAITING:
            raise InputError("too many plans wait to begin", got=MOST_WAITING + 1, allowed=MOST_WAITING)
        before = sooner[-1] if sooner else self._plan
        known = before is not None and before.end > now
        old = before.at(due) if before is not None and known else here
        position, rotation = plan.at(due)
        c = self._config  # what no plan moves goes on no longer than it takes to stop
        ahead = 0.0 if known else min((due - now) / NS, c.speed / c.acceleration)
        most, most_angle = c.step + c.speed * ahead, c.angular_step + c.angular_speed * ahead
        off, angle = float(np.linalg.norm(position - old[0])), angle_between(old[1], rotation)
        if off > most or angle > most_angle:
            raise InputError(
                "plan does not begin where the arm will be",
                got=f"{1e3 * off:.0f} mm, {angle:.2f} rad away",
                allowed=f"{1e3 * most:.0f} mm, {most_angle:.2f} rad",
                next_step="Plan from the measured gripper pose",
            )
        if plan.begin <= now or self._plan is None:
            self._plan, self._waiting = plan, []
        else:
            self._waiting = [*sooner, plan]

    def target(self, now: int, lead: float) -> tuple[Array, Quaternion] | None:
        """The pose to ask for at `now` [ns], `lead` [s] ahead in the plan; None: nothing to ask for.

        None before the first plan begins, after a plan that does not end at rest, and when the plan is too old.
        """
        ask = now + round(lead * NS)
        while self._waiting and self._waiting[0].begin <= ask:
            self._plan = self._waiting.pop(0)
        if self._plan is None or now - self._plan.start > self._lifetime * NS or ask < self._plan.begin:
            return None
        if ask > self._plan.end and not self._plan.ends_at_rest:
            return None
        return self._plan.at(ask)

    def done(self, now: int) -> bool:
        """The plan in force ended at rest, and nothing follows it."""
        plan = self._plan
        return plan is not None and not self._waiting and plan.ends_at_rest and now >= plan.end


def _check_place(plan: Plan, config: GuardConfig) -> None:
    low, high = workspace_of(config)
    out = np.maximum(low - plan.position, plan.position - high).max(axis=1)
    k = int(out.argmax())
    if out[k] > OUTSIDE:
        raise InputError(
            f"plan leaves the workspace at point {k}",
            got=f"{np.round(plan.position[k], 4).tolist()} m, {1e3 * out[k]:.0f} mm outside",
            allowed=f"{low.tolist()} to {high.tolist()} m",
            next_step="Plan inside the arm's workspace, or set its x_low to z_high",
        )


def _check_jumps(plan: Plan, config: GuardConfig) -> None:
    seconds = np.diff(plan.times)
    off = np.linalg.norm(np.diff(plan.position, axis=0), axis=-1)
    w, x, y, z = multiply(_columns(plan.rotation[1:]), conjugate(_columns(plan.rotation[:-1])))
    angle = 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))  # `angle_between`, of all
    jumps = (off > OVER * config.speed * seconds + REST) | (angle > OVER * config.angular_speed * seconds + REST)
    if jumps.any():
        k = int(jumps.argmax())
        raise InputError(
            f"plan jumps after point {k}",
            got=f"{1e3 * off[k]:.1f} mm and {angle[k]:.3f} rad in {seconds[k]:.3f} s",
            allowed=f"{OVER * config.speed:g} m/s and {OVER * config.angular_speed:g} rad/s",
        )


def _columns(rotation: Array) -> Any:
    """The components (K,) of K quaternions, in place of plain numbers."""
    return tuple(rotation.T)


def _wxyz(row: Array) -> Quaternion:
    return (float(row[0]), float(row[1]), float(row[2]), float(row[3]))

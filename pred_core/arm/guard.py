"""The guard in front of every arm: whatever comes in, what goes out stays within the limits.

Commands move a target, the target is clipped to the workspace, a reference follows the target at limited speed, and
`Smoother` makes the set-point of it. A fault freezes the reference: the arm comes to rest within `stop_ticks` ticks,
inside the workspace, and stays there until a person resets and arms again. Time is in ns of one clock, passed in.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from pred_core.arm import orientation
from pred_core.arm.limits import GuardConfig, bounds_of
from pred_core.arm.orientation import Quaternion
from pred_core.arm.protocol import SetPoint
from pred_core.arm.smoother import Smoother
from pred_core.errors import InputError

Array = NDArray[np.float64]
NS = 1e9
UNIT_TOLERANCE = 1e-3  # of a quaternion's norm, as in the bag contract
EDGE = 1e-6  # [m], [rad] by which a measured pose may lie outside when the guard is armed


class Mode(Enum):
    """What the guard does. FAULT is left by `reset` only, DISARMED by `arm` only."""

    DISARMED = "disarmed"
    HOLDING = "armed, waiting for a command"
    MOVING = "following"
    RAMPING = "command is old: stopping"
    FAULT = "fault"


class Guard:
    """State of one arm's guard. `line` says why it is where it is; `counts` what it refused or clipped."""

    def __init__(self, config: GuardConfig, silence: str = "no command"):
        """silence: what a fault says there was, for so and so long, when commands have stopped."""
        self.config, self._silence = config, silence
        self.bounds = bounds_of(config)
        self.mode = Mode.DISARMED
        self.line = "not armed yet"
        self.counts: Counter[str] = Counter()
        self.clipped = ""  # what limit the newest command went beyond; "" if none
        self._upright = orientation.DOWN if config.tool_down else orientation.UP
        self._smoother: Smoother | None = None
        self._reference = np.zeros(6)  # position [m], tilt and yaw [rad]
        self._target = np.zeros(6)
        self._out = np.zeros(6)
        self._setpoint: SetPoint | None = None
        self._asked: tuple[int, Array, Quaternion] | None = None  # stamp [ns] and pose of the newest command
        self._watched: int | None = None  # [ns] stamp the watchdog looks at; None: no stream of commands
        self._due: int | None = None  # [ns] of the next tick
        self._last: int | None = None  # [ns] of the last tick

    @property
    def setpoint(self) -> SetPoint | None:
        """The newest set-point; None before the guard was armed for the first time."""
        return self._setpoint

    @property
    def at_rest(self) -> bool:
        """The set-point stands still, and will until a command comes."""
        if self._smoother is None or self._setpoint is None:
            return True
        settled = self._smoother.at_rest and bool((self._reference == self._out).all())
        return settled and not (self._setpoint.velocity.any() or self._setpoint.angular_velocity.any())

    def arm(self, position: Sequence[float] | Array, rotation: Sequence[float]) -> None:
        """Begin at the measured pose: (3,) [m] world, wxyz.

        Raises: InputError unless disarmed and at rest, with a pose inside the workspace and the cone.
        """
        if self.mode is not Mode.DISARMED:
            raise InputError(f"cannot arm: {self.line}", next_step="Call reset" if self.mode is Mode.FAULT else "")
        if not self.at_rest:
            raise InputError("cannot arm: the last motion has not come to rest yet")
        place, turned = self._checked(position, rotation)
        start, clipped = self._clip(place, turned, 0.0)
        if clipped is not None and clipped[1] > EDGE:
            raise InputError(
                f"cannot arm: the tool is outside the limits ({clipped[0]})",
                got=f"{np.round(place, 4).tolist()} m",
                allowed=f"{self.bounds.low.tolist()} to {self.bounds.high.tolist()} m, tilt {self.config.tilt} rad",
                next_step="Move the arm inside by hand",
            )
        self._smoother = Smoother(start, self.bounds.first, self.bounds.second)
        self._reference, self._target, self._out = start.copy(), start.copy(), start.copy()
        self._setpoint = SetPoint(
            start[:3].copy(), orientation.from_tilt_yaw(_triple(start[3:]), self._upright), np.zeros(3), np.zeros(3)
        )
        self._asked = self._watched = self._due = self._last = None
        self.mode, self.line = Mode.HOLDING, Mode.HOLDING.value

    def disarm(self) -> None:
        """Stop, and follow nothing until armed again. A latched fault stays."""
        if self.mode is not Mode.FAULT:
            self._freeze(Mode.DISARMED, "disarmed")

    def stop(self, why: str) -> None:
        """Latch a fault: come to rest as fast as the limits allow."""
        if self.mode is not Mode.FAULT:
            self._freeze(Mode.FAULT, why)

    def reset(self) -> None:
        """Clear a latched fault; the guard is disarmed then. Raises: InputError while still moving."""
        if not self.at_rest:
            raise InputError("cannot reset: still coming to rest", next_step="Try again in a second")
        if self.mode is Mode.FAULT:
            self.mode, self.line = Mode.DISARMED, "reset; not armed"

    def finish(self) -> None:
        """The stream of commands has ended well: go to the last target and wait there, without a watchdog."""
        if self.mode in (Mode.MOVING, Mode.RAMPING):
            self._watched = self._asked = None
            self.clipped, self.mode, self.line = "", Mode.HOLDING, Mode.HOLDING.value

    def command(self, position: Sequence[float] | Array, rotation: Sequence[float], stamp: int, now: int) -> str | None:
        """Take a commanded pose (3,) [m] world, wxyz, of `stamp` at `now` [ns]. Returns None, or why it was refused.

        Not armed, late, early or out of order: ignored, and the watchdog goes on. Malformed, or a jump: a fault.
        Outside the workspace or the cone: clipped to its edge, counted, and said in `line` while it lasts.
        """
        if self.mode in (Mode.DISARMED, Mode.FAULT):
            return self._refuse("not armed", f"not armed: {self.line}")
        age = (now - stamp) / NS
        if age > self.config.ramp_after:
            allowed = f"allowed: {self.config.ramp_after:g} s; check the sender's clock, and use_sim_time on both"
            return self._refuse("late", f"command is {age:.3f} s old; {allowed}")
        if -age > self.config.ahead:
            allowed = f"allowed: {self.config.ahead:g} s; check the sender's clock, and use_sim_time on both"
            return self._refuse("from the future", f"command is {-age:.3f} s in the future; {allowed}")
        if self._asked is not None and stamp <= self._asked[0]:
            return self._refuse("out of order", f"stamp goes back by {(self._asked[0] - stamp) / NS:.3f} s")
        try:
            place, turned = self._checked(position, rotation)
        except InputError as error:
            self.stop(str(error))
            return self._refuse("malformed", str(error))
        jump = self._jump(place, turned, stamp)
        if jump is not None:
            self.stop(jump)
            return self._refuse("jump", jump)
        target, clipped = self._clip(place, turned, float(self._reference[5]))
        self.clipped = "" if clipped is None else clipped[0]
        if self.clipped:
            self.counts[f"clipped: {self.clipped}"] += 1
        self._target = target
        self._asked, self._watched = (stamp, place, turned), stamp
        self.mode = Mode.MOVING
        self.line = f"{Mode.MOVING.value}, held at a limit: {self.clipped}" if self.clipped else Mode.MOVING.value
        return None

    def measured(self, position: Array, rotation: Quaternion) -> None:
        """Latch a fault when the arm is not where its set-point is, or does not know where it is."""
        if self._setpoint is None or self.mode in (Mode.DISARMED, Mode.FAULT):
            return
        try:
            place, turned = self._checked(position, rotation)
        except InputError as error:
            return self.stop(f"measured {error}")
        off = float(np.linalg.norm(place - self._setpoint.position))
        angle = orientation.angle_between(turned, self._setpoint.rotation)
        if off > self.config.following or angle > self.config.angular_following:
            self.stop(f"the arm does not follow: {1e3 * off:.0f} mm and {angle:.2f} rad from its set-point")

    def tick(self, now: int) -> SetPoint | None:
        """The set-point at `now` [ns]; None before the guard was armed for the first time.

        Call it `rate` times a second. Ticks that come in a burst do not make the arm faster: a tick sooner than half
        a period after the one before returns the same set-point again, and lost ticks are not made up for: the arm has
        stopped by itself when they are many, so while it moves that is a fault.
        """
        if self._smoother is None:
            return None
        if self._last is not None and now < self._last:
            self.stop(f"the clock went back by {(self._last - now) / NS:.3f} s")
            self._due = None
        gap = 0.0 if self._last is None else (now - self._last) / NS
        if gap > self.config.fault_after and self.mode in (Mode.MOVING, Mode.RAMPING):
            self.stop(f"no set-point for {gap:.3f} s while moving: this process was held up")
        self._last = now
        period = round(self.bounds.period * NS)
        if self._due is not None and now < self._due - period // 4:
            return self._setpoint
        self._due = now + period if self._due is None else max(self._due + period, now + 3 * period // 4)
        self._watch(now)
        return self._advance()

    def _watch(self, now: int) -> None:
        if self._watched is None or self.mode not in (Mode.MOVING, Mode.RAMPING):
            return
        age = (now - self._watched) / NS
        if age > self.config.fault_after:
            self.stop(f"{self._silence} for {self.config.fault_after:g} s")
        elif age > self.config.ramp_after and self.mode is Mode.MOVING:
            self._freeze(Mode.RAMPING, Mode.RAMPING.value)
            self.counts["ramps"] += 1

    def _advance(self) -> SetPoint:
        assert self._smoother is not None and self._setpoint is not None  # armed at least once
        period = self.bounds.period
        gap = self._target - self._reference
        step = gap.copy()
        for part, speed in ((slice(0, 3), self.config.speed), (slice(3, 6), self.bounds.turn_speed)):
            length = math.sqrt(float(gap[part] @ gap[part]))
            if length > speed * period:
                step[part] *= speed * period / length
        arrives = bool((step == gap).all())
        self._reference = self._target.copy() if arrives else self._reference + step
        before, self._out = self._out, self._smoother.step(self._reference)
        position = np.clip(self._out[:3], self.bounds.low, self.bounds.high)
        rotation = orientation.from_tilt_yaw(_triple(self._out[3:]), self._upright)
        still = rotation == self._setpoint.rotation  # the product below would round to almost zero
        turned = orientation.multiply(rotation, orientation.conjugate(self._setpoint.rotation))
        self._setpoint = SetPoint(
            position,
            rotation,
            (self._out[:3] - before[:3]) / period,
            np.zeros(3) if still else np.array(orientation.rotation_vector(turned)) / period,
        )
        return self._setpoint

    def _freeze(self, mode: Mode, line: str) -> None:
        self.clipped = ""
        self._target = self._reference.copy()
        self.mode, self.line = mode, line
        if mode is not Mode.RAMPING:
            self._watched = self._asked = None

    def _refuse(self, what: str, line: str) -> str:
        self.counts[f"refused: {what}"] += 1
        return line

    def _checked(self, position: Sequence[float] | Array, rotation: Sequence[float]) -> tuple[Array, Quaternion]:
        place = np.asarray(position, float)
        values = tuple(float(c) for c in rotation)
        if place.shape != (3,) or len(values) != 4:
            raise InputError("pose", got=f"{place.shape} and {len(values)} values", allowed="3 and 4 values")
        norm = math.sqrt(sum(c * c for c in values)) if all(abs(c) < 2.0 for c in values) else math.nan
        if not (np.abs(place) < 1e3).all():
            raise InputError("pose is not finite or beyond 1 km", got=place.tolist())
        if not abs(norm - 1.0) <= UNIT_TOLERANCE:
            raise InputError("pose has a quaternion without unit norm", got=values, allowed="norm 1 +- 0.001")
        return place, (values[0] / norm, values[1] / norm, values[2] / norm, values[3] / norm)

    def _jump(self, place: Array, turned: Quaternion, stamp: int) -> str | None:
        """Why this command is a jump from the one before, None if it is not.

        The first one is compared with the set-point, which may lag behind a moving target by `lag`.
        """
        assert self._setpoint is not None
        seconds = self.bounds.lag if self._asked is None else (stamp - self._asked[0]) / NS
        before = (self._setpoint.position, self._setpoint.rotation) if self._asked is None else self._asked[1:]
        off = float(np.linalg.norm(place - before[0]))
        angle = orientation.angle_between(before[1], turned)
        most = self.config.step + self.config.speed * seconds
        most_angle = self.config.angular_step + self.config.angular_speed * seconds
        if off <= most and angle <= most_angle:
            return None
        found, allowed = f"{1e3 * off:.0f} mm and {angle:.2f} rad", f"{1e3 * most:.0f} mm and {most_angle:.2f} rad"
        return f"command jumps by {found}; allowed: {allowed}"

    def _clip(self, place: Array, turned: Quaternion, near: float) -> tuple[Array, tuple[str, float] | None]:
        """Coordinates (6,) within the limits, and what was clipped by how much [m or rad]."""
        inside = np.clip(place, self.bounds.low, self.bounds.high)
        clipped = None if (inside == place).all() else ("workspace", float(np.abs(inside - place).max()))
        turn = orientation.to_tilt_yaw(turned, self._upright)
        if turn is None:  # upside down: yaw has no meaning, stay as it was
            return np.concatenate((inside, self._reference[3:])), ("tilt", math.pi)
        tilt = math.hypot(turn[0], turn[1])
        share = min(1.0, self.config.tilt / tilt) if tilt > 0.0 else 1.0
        if share < 1.0:
            clipped = ("tilt", tilt - self.config.tilt)
        yaw = orientation.wound(turn[2], near, self.config.turn)
        if math.cos(yaw - turn[2]) < 1.0 - EDGE**2:
            clipped = ("turn", abs(math.remainder(yaw - turn[2], 2.0 * math.pi)))
        return np.concatenate((inside, (share * turn[0], share * turn[1], yaw))), clipped


def _triple(values: Array) -> tuple[float, float, float]:
    return (float(values[0]), float(values[1]), float(values[2]))

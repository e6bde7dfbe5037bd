"""The arm's controller: follows set-points at its own rate, and comes to rest when they cease to come."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import InputError
from pred_core.plant.live.mover import ToolPose, make_pose, multiply, quaternion_of, rotation_between

Array = NDArray[np.float64]
GAIN = 15.0  # [1/s] of the pull towards the set-point, beside its own velocity
DEAD_MAN = 0.1  # [s] after which a set-point counts no more
SPEED, TURN = 1.0, 3.0  # [m/s], [rad/s] the controller's own limits


@dataclass(frozen=True)
class Target:
    """A set-point and when it came."""

    pose: ToolPose
    velocity: Array  # (3,) [m/s] world
    turn: Array  # (3,) [rad/s] world
    time: float  # [s] of the cell


class Servo:
    """Between whoever commands (any thread) and the cell's loop. `fault` holds until `clear`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._target: Target | None = None
        self._following = False
        self.fault = ""

    @property
    def following(self) -> bool:
        """Set-points are taken."""
        return self._following

    def begin(self) -> None:
        """Take set-points from now on. Raises: InputError after a fault: a person clears it, at the plant."""
        with self._lock:
            if self.fault:
                raise InputError(f"plant: {self.fault}", next_step="Call the plant's ~/clear, then enable again")
            self._target, self._following = None, True

    def command(self, pose: ToolPose, velocity: Array, turn: Array, time: float) -> None:
        """A set-point that came at `time` [s]. Raises: InputError if it is not finite, or before `begin`."""
        checked = make_pose(pose.position, pose.rotation)
        v, w = np.array(velocity, float), np.array(turn, float)
        if v.shape != (3,) or w.shape != (3,) or not np.isfinite(np.concatenate([v, w])).all():
            raise InputError("plant: commanded velocity", got=f"{v.tolist()} {w.tolist()}", allowed="finite")
        with self._lock:
            if not self._following:
                raise InputError("plant: a set-point before the arm was enabled")
            self._target = Target(checked, v, w, time)

    def stop(self) -> None:
        """Follow nothing."""
        with self._lock:
            self._target, self._following = None, False

    def fail(self, line: str) -> None:
        """Latch a fault and follow nothing."""
        with self._lock:
            self.fault, self._target, self._following = line, None, False

    def clear(self) -> None:
        """A person has looked."""
        with self._lock:
            self.fault = ""

    def reference(self, now: ToolPose, time: float, period: float) -> ToolPose:
        """Where the reference, now at `now`, shall be `period` [s] after `time` [s]."""
        with self._lock:
            target = self._target
        if target is None or time - target.time > DEAD_MAN:
            return now
        age = time + period - target.time
        ahead = target.pose.position + age * target.velocity
        turned = multiply(quaternion_of(age * target.turn), target.pose.rotation)
        share = min(1.0, GAIN * period)
        step = _limited(share * (ahead - now.position) + (1.0 - share) * period * target.velocity, SPEED * period)
        off = rotation_between(now.rotation, turned)
        turn = _limited(share * off + (1.0 - share) * period * target.turn, TURN * period)
        return ToolPose(now.position + step, multiply(quaternion_of(turn), now.rotation))


def _limited(vector: Array, most: float) -> Array:
    length = float(np.linalg.norm(vector))
    return vector * (most / length) if length > most else vector

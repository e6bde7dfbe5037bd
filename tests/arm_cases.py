"""What the tests of the arm share: the limits measured on a record of set-points, and arms that only remember."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.arm import orientation
from pred_core.arm.guard import Guard
from pred_core.arm.limits import GuardConfig, bounds_of
from pred_core.arm.protocol import SetPoint

Array = NDArray[np.float64]
PERIOD = 8_000_000  # [ns] at the default 125 Hz
HOME = (0.45, 0.0, 0.25)
DOWN = orientation.DOWN
REL, ABS = 1e-6, 1e-4  # rounding: 1e-16 / dt^3 is 1e-8 at 500 Hz; every limit in the tests is above 0.1


def armed(config: GuardConfig | None = None) -> Guard:
    """A guard that was armed at HOME."""
    guard = Guard(config or GuardConfig())
    guard.arm(HOME, DOWN)
    return guard


def _quaternion_steps(q: Array) -> Array:
    """Rotation vectors (T-1, 3) between consecutive quaternions (T, 4) wxyz, in world."""
    w0, v0, w1, v1 = q[:-1, :1], q[:-1, 1:], q[1:, :1], q[1:, 1:]
    w = w1 * w0 + (v1 * v0).sum(-1, keepdims=True)
    v = w0 * v1 - w1 * v0 - np.cross(v1, v0)
    v = np.where(w < 0, -v, v)
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(sine > 1e-9, 2 * np.arctan2(sine, np.abs(w)) / np.maximum(sine, 1e-12), 2.0) * v


def measure(setpoints: list[SetPoint], config: GuardConfig) -> dict[str, float]:
    """The largest share of each limit that the set-points use, the arm at rest before the first: 1 is the limit."""
    bounds = bounds_of(config)
    dt = bounds.period
    position = np.array([s.position for s in [setpoints[0]] * 3 + setpoints])
    rotation = np.array([s.rotation for s in [setpoints[0]] * 3 + setpoints])
    velocity = np.diff(position, axis=0) / dt
    turning = _quaternion_steps(rotation) / dt
    upright = DOWN if config.tool_down else orientation.UP
    axis_z = 1 - 2 * (rotation[:, 1] ** 2 + rotation[:, 2] ** 2)  # z of the tool's z axis
    tilt = np.arccos(np.clip(axis_z * (1 - 2 * upright[1] ** 2), -1, 1))

    def largest(series: Array, order: int, limit: float) -> float:
        derivative = np.diff(series, n=order, axis=0) / dt**order
        return float(np.linalg.norm(derivative, axis=-1).max() / limit)

    reported = np.array([s.velocity for s in setpoints[1:]]).reshape(-1, 3)
    return {
        "box": float(max((position - bounds.high).max(), (bounds.low - position).max())),
        "tilt": float((tilt - config.tilt).max()),
        "speed": largest(velocity, 0, config.speed),
        "acceleration": largest(velocity, 1, config.acceleration),
        "jerk": largest(velocity, 2, config.jerk),
        "angular speed": largest(turning, 0, config.angular_speed),
        "angular acceleration": largest(turning, 1, config.angular_acceleration),
        "angular jerk": largest(turning, 2, config.angular_jerk),
        "velocity error": float(np.abs(reported - velocity[3:]).max(initial=0.0)),
        "norm": float(np.abs(np.linalg.norm(rotation, axis=-1) - 1).max()),
    }


def broken(found: dict[str, float]) -> dict[str, float]:
    """The limits that do not hold. Box: to the last bit; tilt: arccos of a rounded number near its edge."""
    zero = {"box": 0.0, "tilt": 1e-7, "norm": 1e-12, "velocity error": 1e-9}
    return {k: v for k, v in found.items() if not v <= zero.get(k, 1 + REL + ABS)}


class Recorder:
    """Stands in for a driver: answers from a table, and remembers every call in order."""

    def __init__(self, **answers: Any):
        self.answers = answers
        self.calls: list[tuple[str, tuple[Any, ...]]] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name not in self.answers:
            raise AttributeError(name)
        answer = self.answers[name]
        if not callable(answer):
            return answer

        def call(*args: Any, **kwargs: Any) -> Any:
            self.calls.append((name, (*args, *kwargs.values())))
            return answer(*args, **kwargs)

        return call

    def names(self) -> list[str]:
        """The calls, without their arguments."""
        return [name for name, _ in self.calls]

    def last(self, name: str) -> tuple[Any, ...]:
        """Arguments of the last call of a name."""
        return [args for called, args in self.calls if called == name][-1]

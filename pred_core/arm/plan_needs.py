"""What a plan needs of an arm: the parameters of the arm node it must be given, at least, so that it keeps up."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pred_core.arm.limits import GuardConfig
from pred_core.arm.orientation import Quaternion, conjugate, multiply, rotation_vector

Array = NDArray[np.float64]
LIFETIME = 3.0  # [s] after which the arm node follows a plan no more, unless it is told otherwise
AFTER = 1.0  # [s] that it may begin late


def needs_of(times: Array, position: Array, rotation: Array) -> dict[str, float]:
    """Parameter -> least value, rounded up: speed [m/s], acceleration [m/s^2], both of rotations, lifetime [s].

    times (K,) [s], increasing; position (K, 3) [m]; rotation (K, 4) wxyz, unit.
    """
    turns = np.zeros((len(times) - 1, 3))
    for k in range(len(turns)):
        before, after = _wxyz(rotation[k]), _wxyz(rotation[k + 1])
        turns[k] = rotation_vector(multiply(after, conjugate(before)))
    speed, acceleration = _peaks(times, np.diff(position, axis=0))
    angular_speed, angular_acceleration = _peaks(times, turns)
    raw = {
        "speed": speed, "acceleration": acceleration, "angular_speed": angular_speed,
        "angular_acceleration": angular_acceleration, "lifetime": float(times[-1]) + AFTER,
    }  # fmt: skip
    return {name: math.ceil(100.0 * value - 1e-6) / 100.0 for name, value in raw.items()}


def as_parameters(needs: Mapping[str, float], config: GuardConfig) -> str:
    """The needs that `config` and the usual lifetime fall short of, as a node takes them: "-p speed:=0.8"; "" if none.
    """
    short = {k: v for k, v in needs.items() if v > getattr(config, k, LIFETIME)}
    return " ".join(f"-p {name}:={value:g}" for name, value in short.items())


def _peaks(times: Array, steps: Array) -> tuple[float, float]:
    """Largest speed and acceleration of steps (K - 1, 3) between the times; before and after it rests."""
    seconds = np.diff(times)
    velocity = np.concatenate((np.zeros((1, 3)), steps / seconds[:, None], np.zeros((1, 3))))
    middle = np.concatenate((seconds[:1], (seconds[1:] + seconds[:-1]) / 2.0, seconds[-1:]))
    change = np.diff(velocity, axis=0) / middle[:, None]
    return float(np.linalg.norm(velocity, axis=-1).max()), float(np.linalg.norm(change, axis=-1).max())


def _wxyz(row: Array) -> Quaternion:
    return (float(row[0]), float(row[1]), float(row[2]), float(row[3]))

"""What every arm understands, and nothing more. Adapters: dry_run.py, plant.py, ur.py, xarm.py."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pred_core.arm.orientation import Quaternion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SetPoint:
    """Where the tool centre shall be at the end of this tick. Only the guard makes these."""

    position: Array  # (3,) [m] world
    rotation: Quaternion  # wxyz, world_from_tool
    velocity: Array  # (3,) [m/s] world
    angular_velocity: Array  # (3,) [rad/s] world


@dataclass(frozen=True)
class Reading:
    """What an arm reports."""

    position: Array  # (3,) [m] world
    rotation: Quaternion  # wxyz, world_from_tool
    ready: bool  # it would follow a set-point
    message: str  # one line: why it is not ready, or its mode
    closed: bool | None = None  # the jaws; None: the arm does not know
    joints: dict[str, float] = field(default_factory=dict)  # [rad] by name; empty: unknown
    stamp: int | None = None  # [ns] of the measurement, on the node's clock; None: the arm does not say, now


class Arm(Protocol):
    """One arm. Every method may raise InputError with one line; after that the node stops the arm."""

    def read(self) -> Reading:
        """The measured pose and state, now."""
        ...

    def begin(self) -> None:
        """Get ready to follow set-points. Never clears an error or a protective stop: people do that, at the arm."""
        ...

    def command(self, setpoint: SetPoint) -> None:
        """Follow this set-point. The arm must stop by itself when these cease to come."""
        ...

    def stop(self) -> None:
        """Come to rest now and follow nothing until `begin`. Safe to call at any time, also twice."""
        ...

    def close(self) -> None:
        """Stop and let go of the connection."""
        ...

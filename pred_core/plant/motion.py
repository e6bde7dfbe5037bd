"""Random smooth gripper motions of declared families, drawn from a seed and from nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.errors import ConfigError

Array = NDArray[np.float64]
REGIMES = ("air", "table")
VARIANTS = ("usual", "fast", "height", "regrasp")  # all but the first are out of distribution
FAST = 1.5  # times the speed of the usual motions
HIGHER = {"air": 0.25, "table": 0.06}  # [m] above the usual height
HOME = {"air": (0.0, 0.0, 1.0), "table": (0.3, 0.0, 0.11)}  # [m] middle of the homes
SPREAD = {"air": (0.15, 0.15, 0.05), "table": (0.08, 0.12, 0.015)}  # [m] half width of the homes
SLANT = {"air": 0.0, "table": 1.0}  # [rad] pitch of the home: the rope leaves downwards, or slanting towards -x


@dataclass(frozen=True)
class MotionFamily:
    """What is common to the motions of a family: sways and moves between rests, in six coordinates."""

    sway: float = setting(0.055, unit="m", low=0.0, high=0.3, doc="largest amplitude of a sway; two sways an axis")
    sway_low: float = setting(0.25, unit="Hz", low=0.0, doc="slowest sway")
    sway_high: float = setting(0.9, unit="Hz", low=0.0, doc="fastest sway")
    reach: float = setting(0.16, unit="m", low=0.0, high=1.0, doc="largest single move along an axis in the air")
    turn: float = setting(0.5, unit="rad", low=0.0, high=1.5, doc="largest single turn in yaw; half in pitch and roll")
    moves: int = setting(3, low=0, high=20, doc="moves an episode")


@dataclass(frozen=True)
class Path:
    """Reference of the drive at every step: x, y, z [m], yaw, pitch, roll [rad], each (steps, 6)."""

    position: Array
    velocity: Array  # [m/s], [rad/s]
    acceleration: Array  # [m/s^2], [rad/s^2]


@dataclass(frozen=True)
class Motion:
    """One drawn motion. Coordinates: x, y, z, yaw, pitch, roll. At rest at `home` until `onset`."""

    regime: str
    variant: str
    home: Array  # (6,)
    onset: float  # [s]
    sway: Array  # (2, 6) amplitude
    frequency: Array  # (2, 6) [Hz]
    phase: Array  # (2, 6) [rad]
    step: Array  # (moves, 6) change of a move
    begin: Array  # (moves,) [s] after onset
    length: Array  # (moves,) [s]

    def path(self, begin: float, steps: int, dt: float) -> Path:
        """The reference at begin + k dt, k = 0..steps-1 [s].

        Velocity is the backward and acceleration the second difference: what takes the semi-implicit Euler
        steps of the drive exactly from one reference to the next.
        """
        speed = FAST if self.variant == "fast" else 1.0
        at = begin + dt * np.arange(-1, steps + 1)
        time = np.maximum(at - self.onset, 0.0)[:, None] * speed
        fade = _smooth_step(time / 0.6)[..., None]
        sways = (self.sway * np.sin(2 * np.pi * self.frequency * time[..., None] + self.phase)).sum(axis=1)
        moves = _smooth_step((time - self.begin) / self.length) @ self.step
        x = self.home + fade[:, 0] * sways + moves
        if self.regime == "table":  # the jaws stay above the table
            low = self.home[2] - 0.025
            x[:, 2] = low + np.logaddexp(0.0, 60.0 * (x[:, 2] - low)) / 60.0
        return Path(x[1:-1], (x[1:-1] - x[:-2]) / dt, (x[2:] - 2 * x[1:-1] + x[:-2]) / dt**2)


def draw_motion(
    generator: np.random.Generator, regime: str, variant: str, seconds: float, family: MotionFamily | None = None
) -> Motion:
    """A motion that lasts `seconds` [s]. Raises: ConfigError for an unknown regime or variant."""
    if regime not in REGIMES or variant not in VARIANTS:
        raise ConfigError("motion", got=f"{regime} {variant}", allowed=f"{REGIMES} x {VARIANTS}")
    family = family or MotionFamily()
    home = np.zeros(6)
    home[:3] = np.array(HOME[regime]) + np.array(SPREAD[regime]) * generator.uniform(-1, 1, 3)
    home[3:] = generator.uniform(-1, 1, 3) * (0.5, 0.12, 0.12)
    home[4] += SLANT[regime]
    if variant == "height":
        home[2] += HIGHER[regime]
    scale = np.array([1.0, 1.0, 0.3 if regime == "table" else 0.6, 0.0, 0.0, 0.0])
    turns = np.array([0.0, 0.0, 0.0, 1.0, 0.5, 0.5])
    shape = (2, 6)
    sway = generator.uniform(0.3, 1.0, shape) * (family.sway * scale + 0.2 * family.turn * turns)
    drag = np.array([1.7, 1.7, 1.0, 1.0, 1.0, 1.0]) if regime == "table" else np.ones(6)  # long enough to slide it all
    step = generator.uniform(-1, 1, (family.moves, 6)) * drag * (family.reach * scale + family.turn * turns)
    step -= 0.7 * step.mean(axis=0, keepdims=True)  # moves come back, so that the rope stays in view
    slots = seconds / max(family.moves, 1)
    return Motion(
        regime=regime,
        variant=variant,
        home=home,
        onset=float(generator.uniform(0.05, 0.4)),
        sway=sway,
        frequency=generator.uniform(family.sway_low, family.sway_high, shape),
        phase=generator.uniform(0, 2 * np.pi, shape),
        step=step,
        begin=slots * (np.arange(family.moves) + generator.uniform(0.0, 0.3, family.moves)),
        length=generator.uniform(0.6, 1.2, family.moves),
    )


def _smooth_step(x: Array) -> Array:
    """0 before 0, 1 after 1, twice continuously differentiable between (minimum jerk)."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)

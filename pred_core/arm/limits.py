"""What an arm may do: workspace, tilt, speed, acceleration, jerk, and how long it may be left without a command."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.errors import ConfigError

Array = NDArray[np.float64]


MOST_LIFETIME = 600.0  # [s] of a plan, whatever the arm node is told


@dataclass(frozen=True)
class GuardConfig:
    """Limits of the guard, in `world`. They hold for every set-point that goes to an arm."""

    rate: float = setting(125.0, unit="Hz", low=20.0, high=500.0, doc="set-points a second")
    x_low: float = setting(0.2, unit="m", low=-3.0, high=3.0, doc="workspace box of the tool centre")
    x_high: float = setting(0.7, unit="m", low=-3.0, high=3.0, doc="workspace box")
    y_low: float = setting(-0.4, unit="m", low=-3.0, high=3.0, doc="workspace box")
    y_high: float = setting(0.4, unit="m", low=-3.0, high=3.0, doc="workspace box")
    z_low: float = setting(0.0, unit="m", low=-3.0, high=3.0, doc="workspace box")
    z_high: float = setting(0.6, unit="m", low=-3.0, high=3.0, doc="workspace box")
    table: float = setting(0.0, unit="m", low=-3.0, high=3.0, doc="height of the table plane")
    clearance: float = setting(0.02, unit="m", low=0.0, high=0.5, doc="least height of the tool centre above the table")
    tool_down: bool = setting(True, doc="the untilted tool's z axis points down (a flange); false: up")
    tilt: float = setting(0.6, unit="rad", low=0.0, high=1.4, doc="half angle of the cone of the tool axis")
    turn: float = setting(2 * math.pi, unit="rad", low=0.1, high=20.0, doc="largest yaw to either side, wound up")
    speed: float = setting(0.25, unit="m/s", low=0.001, high=2.0, doc="largest speed")
    acceleration: float = setting(2.0, unit="m/s^2", low=0.01, high=50.0, doc="largest acceleration")
    jerk: float = setting(40.0, unit="m/s^3", low=0.1, high=5000.0, doc="largest jerk")
    angular_speed: float = setting(1.0, unit="rad/s", low=0.01, high=6.0, doc="largest angular speed")
    angular_acceleration: float = setting(8.0, unit="rad/s^2", low=0.1, high=200.0, doc="largest angular acceleration")
    angular_jerk: float = setting(150.0, unit="rad/s^3", low=1.0, high=20000.0, doc="largest angular jerk")
    step: float = setting(0.05, unit="m", low=0.001, high=0.5, doc="largest jump of a command, beside speed x time")
    angular_step: float = setting(0.3, unit="rad", low=0.01, high=1.5, doc="largest jump of a commanded rotation")
    ramp_after: float = setting(0.1, unit="s", low=0.02, high=1.0, doc="age of the command at which the arm stops")
    fault_after: float = setting(0.5, unit="s", low=0.05, high=5.0, doc="age of the command that latches a fault")
    ahead: float = setting(0.02, unit="s", low=0.0, high=0.1, doc="how far a stamp may lie in the future")
    following: float = setting(0.08, unit="m", low=0.005, high=0.5, doc="largest distance of arm and set-point")
    angular_following: float = setting(0.5, unit="rad", low=0.02, high=2.0, doc="largest angle of arm and set-point")


@dataclass(frozen=True)
class Bounds:
    """What the guard computes with: the configuration checked, and in the coordinates of the smoother.

    Rotation coordinates u = (tilt_x, tilt_y, yaw) (orientation.py). With |u'| <= V, |u''| <= A, |u'''| <= J:
    angular speed <= sqrt(2) V, because the left Jacobian of SO(3) contracts; angular acceleration <= sqrt(2) A +
    c V^2; angular jerk <= sqrt(2) J + d A V + e V^3. Over tilts up to 1.4 rad the largest c, d, e found by sampling
    are 0.53, 1.97 and 0.40 (tests/test_arm_orientation.py); 0.75, 2.5 and 0.75 are used.
    """

    period: float  # [s]
    low: Array  # (3,) [m]
    high: Array  # (3,) [m]
    turn_speed: float  # V [rad/s]
    first: int  # ticks of the first moving average, >= 2 speed / (acceleration period)
    second: int  # ticks of the second moving average, >= 2 acceleration / (jerk period)

    @property
    def lag(self) -> float:
        """Mean delay from reference to set-point [s]."""
        return 0.5 * self.stop_ticks * self.period

    @property
    def stop_ticks(self) -> int:
        """Ticks after which the set-point stands still once the reference does."""
        return self.first + self.second - 2

    def stop_distance(self, speed: float) -> float:
        """The farthest the set-point goes on after the reference is frozen [m], for a speed limit [m/s]."""
        return speed * self.lag


def workspace_of(config: GuardConfig) -> tuple[Array, Array]:
    """Corners (3,) [m] of the tool centre's box, above the table. Raises: ConfigError for an empty one."""
    low = np.array([config.x_low, config.y_low, max(config.z_low, config.table + config.clearance)])
    high = np.array([config.x_high, config.y_high, config.z_high])
    if not (low < high).all():
        raise ConfigError(
            "the workspace box is empty", got=f"{low.tolist()} to {high.tolist()} m", allowed="low below high"
        )
    return low, high


def bounds_of(config: GuardConfig) -> Bounds:
    """Raises: ConfigError for an empty box, or limits that cannot hold together."""
    low, high = workspace_of(config)
    if config.fault_after <= config.ramp_after:
        raise ConfigError(
            "fault_after", got=f"{config.fault_after} s", allowed=f"more than ramp_after {config.ramp_after} s"
        )
    speed = config.angular_speed / math.sqrt(2.0)
    acceleration = (config.angular_acceleration - 0.75 * speed**2) / math.sqrt(2.0)
    jerk = (config.angular_jerk - 2.5 * acceleration * speed - 0.75 * speed**3) / math.sqrt(2.0)
    if acceleration <= 0.0 or jerk <= 0.0:
        raise ConfigError(
            "angular_acceleration or angular_jerk is too small for angular_speed",
            got=f"{config.angular_speed} rad/s, {config.angular_acceleration} rad/s^2, {config.angular_jerk} rad/s^3",
            next_step="Lower angular_speed",
        )
    period = 1.0 / config.rate
    first = max(2 * config.speed / config.acceleration, 2 * speed / acceleration)
    second = max(2 * config.acceleration / config.jerk, 2 * acceleration / jerk)
    ticks = math.ceil(first / period), math.ceil(second / period)
    if sum(ticks) > 5.0 / period:
        raise ConfigError(
            "the arm would need more than 5 s to stop", got=f"{sum(ticks) * period:.1f} s", next_step="Raise jerk"
        )
    return Bounds(period, low, high, speed, max(1, ticks[0]), max(1, ticks[1]))

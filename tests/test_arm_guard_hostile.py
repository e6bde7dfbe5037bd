"""Whatever comes in, what goes out stays within the limits: 100,000 hostile streams, 1,000 long ones, and shrinking."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from arm_cases import HOME, broken, measure
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pred_core.arm import orientation
from pred_core.arm.guard import Guard, Mode
from pred_core.arm.limits import GuardConfig
from pred_core.arm.protocol import SetPoint
from pred_core.errors import InputError

STREAMS, TICKS = 1000, 100
SHORT = 100_000  # streams of one to four commands
CONFIGS = (
    GuardConfig(),
    GuardConfig(rate=500.0, speed=1.0, acceleration=10.0, jerk=500.0, x_low=0.4, x_high=0.5, step=0.3),
    GuardConfig(rate=50.0, tool_down=False, tilt=1.4, turn=1.0, angular_speed=2.0, angular_acceleration=20.0,
                angular_jerk=600.0, angular_step=1.5),
    GuardConfig(rate=100.0, table=0.2, clearance=0.045, tilt=0.0, speed=0.5, acceleration=1.0, jerk=20.0),
)  # fmt: skip
POISON = (math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0, 5e-324)


class Attack:
    """One stream: commands that push as hard as the guard lets them, with garbage, gaps and clock faults between."""

    def __init__(self, rng: np.random.Generator, config: GuardConfig):
        self.rng, self.config, self.guard = rng, config, Guard(config)
        self.period = round(1e9 / config.rate)
        self.garbage = rng.choice((0.0, 0.0, 0.02, 0.3))
        self.silence = rng.choice((0.0, 0.1, 0.9))
        self.clock = rng.choice((0.0, 0.0, 0.02))
        self.now = int(rng.integers(0, 10**18))
        self.place, self.turned = np.array(HOME), orientation.DOWN if config.tool_down else orientation.UP
        self.push = rng.normal(size=6)
        self.seen: list[SetPoint] = []

    def run(self, ticks: int) -> None:
        """Tick after tick; a disarmed guard at rest is armed again, where it is."""
        self.guard.arm(self.place, self.turned)
        assert self.guard.setpoint is not None
        self.seen.append(self.guard.setpoint)
        for _ in range(ticks):
            self._poke()
            if self.rng.random() < self.clock:
                self.now += int(self.rng.choice((-(10**9), -1, 0, 10**9)))
            self.now += self.period
            setpoint = self.guard.tick(self.now)
            assert setpoint is not None
            self.seen.append(setpoint)

    def _poke(self) -> None:
        roll = self.rng.random()
        if self.guard.mode is Mode.FAULT or self.guard.mode is Mode.DISARMED:
            self._revive()
        elif roll < 0.002:
            self.guard.stop("hostile")
        elif roll < 0.004:
            self.guard.disarm()
        elif roll < 0.006:
            self.guard.finish()
        if self.rng.random() >= self.silence:
            self._command()

    def _revive(self) -> None:
        if self.guard.at_rest:
            self.guard.reset()
            setpoint = self.guard.setpoint
            assert setpoint is not None
            self.place, self.turned = setpoint.position.copy(), setpoint.rotation
            self.guard.arm(self.place, self.turned)
        else:
            for forbidden in (self.guard.reset, lambda: self.guard.arm(self.place, self.turned)):
                with pytest.raises(InputError):
                    forbidden()

    def _command(self) -> None:
        if self.rng.random() < 0.15:  # turn round: full reversals are the worst case of two moving averages
            self.push = self.rng.normal(size=6) if self.rng.random() < 0.5 else -self.push
        reach = self.rng.uniform(0.0, 1.0, 2) * (self.config.step, self.config.angular_step)
        self.place = self.place + self.push[:3] / np.linalg.norm(self.push[:3]) * reach[0]
        turn = self.push[3:] / np.linalg.norm(self.push[3:]) * reach[1]
        self.turned = orientation.multiply(
            orientation.from_rotation_vector((float(turn[0]), float(turn[1]), float(turn[2]))), self.turned
        )
        values = [*self.place.tolist(), *self.turned]
        stamp = self.now
        if self.rng.random() < self.garbage:
            values[self.rng.integers(7)] = float(self.rng.choice(POISON))
            stamp += int(self.rng.choice((0, 0, -(10**9), 10**9, -1)))
        self.guard.command(values[:3], values[3:], stamp, self.now)


def test_100000_hostile_ticks_leave_no_limit() -> None:
    worst: dict[str, float] = {}
    met: Counter[str] = Counter()
    ticks = 0
    for k in range(STREAMS):
        config = CONFIGS[k % len(CONFIGS)]
        attack = Attack(np.random.default_rng(k), config)
        attack.run(TICKS)
        found = measure(attack.seen, config)
        assert not broken(found), (k, broken(found))
        worst = {name: max(value, worst.get(name, -math.inf)) for name, value in found.items()}
        met += attack.guard.counts
        ticks += len(attack.seen) - 1
    assert ticks == 100_000
    # The attack is strong: it drives every limit to its edge, and reaches every way of refusing.
    assert min(worst[name] for name in ("speed", "acceleration", "jerk")) > 0.95, worst
    # Rotation is limited in tilt and yaw, so that a turn about one axis has 1 / sqrt(2) of the limit.
    assert worst["angular speed"] > 0.7 and worst["angular acceleration"] > 0.5, worst
    assert worst["box"] == 0.0 and worst["tilt"] > -1e-3, worst
    kinds = {k.split(": ")[1] for k in met if k.startswith("refused")}
    assert kinds == {"not armed", "late", "from the future", "out of order", "malformed", "jump"}, met
    assert met["clipped: workspace"] > 1000 and met["clipped: tilt"] > 1000 and met["ramps"] > 20, met


def test_100000_hostile_streams_leave_no_limit_from_the_first_command_on() -> None:
    """Short ones: what a guard lets through while it starts is the arm's first jerk."""
    refused: Counter[str] = Counter()
    for k in range(SHORT):
        config = CONFIGS[k % len(CONFIGS)]
        attack = Attack(np.random.default_rng(10**6 + k), config)
        attack.run(1 + (k // len(CONFIGS)) % 4)
        found = measure(attack.seen, config)
        assert not broken(found), (k, broken(found))
        refused += attack.guard.counts
    assert sum(refused[name] for name in refused if name.startswith("refused")) > SHORT // 20


NUMBERS = st.one_of(st.floats(-2.0, 2.0), st.floats(allow_nan=True, allow_infinity=True))
EVENT = st.tuples(
    st.lists(NUMBERS, min_size=3, max_size=3),
    st.one_of(st.just([0.0, 1.0, 0.0, 0.0]), st.lists(NUMBERS, min_size=4, max_size=4)),
    st.sampled_from((0, 0, 0, -1, -200_000_000, 50_000_000, -(10**12))),  # [ns] stamp against now
    st.sampled_from((1, 1, 1, 1, 0, -5, 40)),  # periods until the next tick
    st.integers(1, 60),  # ticks with this command
)


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(st.lists(EVENT, min_size=1, max_size=6))
def test_no_sequence_leaves_the_limits(events: list[tuple[Any, ...]]) -> None:
    config = dataclasses.replace(GuardConfig(), step=0.5, angular_step=1.5)
    guard = Guard(config)
    guard.arm(HOME, orientation.DOWN)
    assert guard.setpoint is not None
    now, seen = 10**15, [guard.setpoint]
    for place, turned, stamp, gap, ticks in events:
        for _ in range(ticks):
            guard.command(place, turned, now + stamp, now)
            now += 8_000_000 * gap
            setpoint = guard.tick(now)
            assert setpoint is not None
            if setpoint is not seen[-1]:  # a burst of ticks gets the same one again, at one and the same time
                seen.append(setpoint)
        if guard.mode is Mode.FAULT and guard.at_rest:
            guard.reset()
            guard.arm(seen[-1].position, seen[-1].rotation)
    assert not broken(measure(seen, config))


def test_the_measurement_sees_a_broken_limit() -> None:
    guard = Guard(GuardConfig())
    guard.arm(HOME, orientation.DOWN)
    start = guard.tick(0)
    assert start is not None
    jumped = dataclasses.replace(start, position=start.position + (0.0, 0.0, 0.0021))  # 0.2625 m/s
    assert set(broken(measure([start, start, jumped], GuardConfig()))) >= {"speed", "acceleration", "jerk"}
    outside = dataclasses.replace(start, position=np.array([0.45, 0.0, 0.019]))
    assert "box" in broken(measure([outside], GuardConfig()))
    tilted = dataclasses.replace(
        start, rotation=orientation.multiply(orientation.from_rotation_vector((0.61, 0.0, 0.0)), orientation.DOWN)
    )
    assert "tilt" in broken(measure([tilted], GuardConfig()))

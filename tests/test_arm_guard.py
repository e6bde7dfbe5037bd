"""The guard's promises, each with a number: times, distances, who may re-arm."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from arm_cases import DOWN, HOME, PERIOD, armed, broken, measure

from pred_core.arm import orientation
from pred_core.arm.guard import Guard, Mode
from pred_core.arm.limits import GuardConfig, bounds_of
from pred_core.arm.protocol import SetPoint
from pred_core.errors import ConfigError, InputError

MS = 1_000_000  # [ns]


def drive(guard: Guard, now: int, step: tuple[float, float, float], ticks: int) -> tuple[int, list[SetPoint]]:
    """A command each tick, `step` [m] beyond the last, beginning at the set-point; then its tick."""
    assert guard.setpoint is not None
    place, seen = guard.setpoint.position.copy(), []
    for _ in range(ticks):
        now += PERIOD
        place = place + step
        assert guard.command(place, guard.setpoint.rotation, now, now) is None
        setpoint = guard.tick(now)
        assert setpoint is not None
        seen.append(setpoint)
    return now, seen


def silent(guard: Guard, now: int, ticks: int) -> tuple[int, list[SetPoint]]:
    """Ticks without a command."""
    seen = []
    for _ in range(ticks):
        now += PERIOD
        setpoint = guard.tick(now)
        assert setpoint is not None
        seen.append(setpoint)
    return now, seen


def test_windows_and_stopping_worked_out_by_hand() -> None:
    config = dataclasses.replace(
        GuardConfig(), angular_speed=0.1, angular_acceleration=8.0, angular_jerk=1000.0, rate=100.0
    )
    bounds = bounds_of(config)
    # 2 * 0.25 / 2.0 = 0.25 s -> 25 ticks; 2 * 2.0 / 40 = 0.1 s -> 10 ticks; (25 + 10 - 2) / 2 * 0.01 s = 0.165 s.
    assert (bounds.first, bounds.second, bounds.stop_ticks) == (25, 10, 33)
    assert bounds.lag == pytest.approx(0.165) and bounds.stop_distance(0.25) == pytest.approx(0.04125)
    assert bounds.low[2] == 0.02  # the table plane and its clearance, above the box's floor


def test_a_legal_goal_is_reached_exactly_and_in_time() -> None:
    guard = armed()
    goal, turned = (
        np.array([0.6, 0.3, 0.4]),
        orientation.multiply(orientation.from_rotation_vector((0.2, -0.3, 1.0)), DOWN),
    )
    now, seen = 0, []
    distance = float(np.linalg.norm(goal - HOME))
    angle = orientation.angle_between(DOWN, turned)
    # The reference at its speed limits, then the two averages.
    due = max(distance / guard.config.speed, math.sqrt(2) * 1.2 * angle / guard.config.angular_speed)
    ticks = math.ceil(due / guard.bounds.period) + guard.bounds.stop_ticks + 2
    for k in range(ticks):
        now += PERIOD
        share = min(1.0, 0.01 * (k + 1))
        place = np.array(HOME) + share * (goal - HOME)
        assert guard.command(place, orientation.slerp(DOWN, turned, share), now, now) is None
        setpoint = guard.tick(now)
        assert setpoint is not None
        seen.append(setpoint)
    assert np.abs(seen[-1].position - goal).max() < 1e-15
    assert orientation.angle_between(seen[-1].rotation, turned) < 1e-12
    assert guard.at_rest and not seen[-1].velocity.any() and not broken(measure(seen, guard.config))


def test_ramp_at_100_ms_and_latch_at_500_ms_to_the_tick() -> None:
    guard = armed()
    now, _ = drive(guard, 0, (0.002, 0.0, 0.0), 60)  # 0.25 m/s
    last, speeds, modes = now, [], []
    for _ in range(80):
        now += PERIOD
        setpoint = guard.tick(now)
        assert setpoint is not None
        speeds.append(float(np.linalg.norm(setpoint.velocity)))
        modes.append(((now - last) // MS, guard.mode))
    ages = {mode: min(age for age, m in modes if m is mode) for mode in (Mode.RAMPING, Mode.FAULT)}
    assert ages == {Mode.RAMPING: 104, Mode.FAULT: 504}  # the first ticks of 8 ms beyond 100 and 500 ms
    assert all(m is Mode.MOVING for age, m in modes if age <= 100)
    frozen = 104 // 8 - 1  # first tick with a frozen reference
    assert (np.diff(speeds[frozen:]) <= 1e-12).all()
    assert speeds[frozen + guard.bounds.stop_ticks - 1] > 0.0 or guard.at_rest
    assert max(speeds[frozen + guard.bounds.stop_ticks :]) == 0.0
    assert guard.line == "no command for 0.5 s"


def test_exactly_100_ms_and_500_ms_are_still_good() -> None:
    config = dataclasses.replace(GuardConfig(), rate=50.0)
    for silence, mode in ((100, Mode.MOVING), (120, Mode.RAMPING), (500, Mode.RAMPING), (520, Mode.FAULT)):
        guard = armed(config)
        assert guard.command(HOME, DOWN, 0, 0) is None
        for k in range(silence // 20):
            guard.tick((k + 1) * 20 * MS)
        assert guard.mode is mode, silence


def test_a_command_during_the_ramp_goes_on() -> None:
    guard = armed()
    now, before = drive(guard, 0, (0.002, 0.0, 0.0), 40)
    now, pause = silent(guard, now, 37)  # 296 ms
    assert guard.mode is Mode.RAMPING
    now, after = drive(guard, now, (0.002, 0.0, 0.0), 40)
    assert guard.mode is Mode.MOVING and after[-1].position[0] > pause[-1].position[0] + 0.03
    assert not broken(measure(before + pause + after, guard.config))


def test_stopping_distance_is_what_is_promised() -> None:
    guard = armed()
    now, seen = drive(guard, 0, (0.002, 0.0, 0.0), 100)
    assert np.linalg.norm(seen[-1].velocity) == pytest.approx(0.25)
    guard.stop("test")
    _, rest = silent(guard, now, guard.bounds.stop_ticks + 1)
    assert guard.at_rest
    gone = float(rest[-1].position[0] - seen[-1].position[0])
    assert gone == pytest.approx(guard.bounds.stop_distance(0.25), rel=1e-9)


@pytest.mark.parametrize("direction", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
def test_at_full_speed_into_every_wall(direction: tuple[int, int, int]) -> None:
    guard = armed()
    step = (0.0025 * direction[0], 0.0025 * direction[1], 0.0025 * direction[2])
    _, seen = drive(guard, 0, step, 300)
    axis = int(np.argmax(np.abs(direction)))
    wall = (guard.bounds.high if direction[axis] > 0 else guard.bounds.low)[axis]
    assert seen[-1].position[axis] == wall
    assert not broken(measure(seen, guard.config))
    assert guard.counts["clipped: workspace"] > 50


def test_the_table_holds_where_the_box_would_not() -> None:
    config = dataclasses.replace(GuardConfig(), z_low=-0.5, table=0.1, clearance=0.03)
    guard = armed(config)
    _, seen = drive(guard, 0, (0.0, 0.0, -0.002), 200)
    assert seen[-1].position[2] == pytest.approx(0.13, abs=1e-15)
    assert min(s.position[2] for s in seen) >= 0.13


def test_only_reset_and_enable_by_a_person_move_it_again() -> None:
    guard = armed()
    now, _ = drive(guard, 0, (0.002, 0.0, 0.0), 30)
    guard.stop("e-stop")
    with pytest.raises(InputError, match="still coming to rest"):
        guard.reset()
    now, _ = silent(guard, now, 60)
    assert guard.setpoint is not None
    here = guard.setpoint.position
    assert guard.command(here, DOWN, now, now) == "not armed: e-stop"
    with pytest.raises(InputError, match="cannot arm: e-stop"):
        guard.arm(here, DOWN)
    guard.disarm()
    assert guard.mode is Mode.FAULT  # disarming does not clear a fault
    guard.stop("another reason")
    assert guard.line == "e-stop"  # the first reason stays
    guard.reset()
    assert guard.mode is Mode.DISARMED
    refused = guard.command(here, DOWN, now, now)
    assert refused is not None and refused.startswith("not armed")
    guard.arm(here, DOWN)
    now, seen = drive(guard, now, (0.002, 0.0, 0.0), 30)
    assert seen[-1].position[0] > here[0]


@pytest.mark.parametrize(
    ("place", "turned", "word"),
    [
        ((math.nan, 0.0, 0.2), DOWN, "not finite"),
        ((0.45, math.inf, 0.2), DOWN, "not finite"),
        (HOME, (0.0, 1.1, 0.0, 0.0), "unit norm"),
        (HOME, (math.nan, 1.0, 0.0, 0.0), "unit norm"),
        (HOME, (0.0, 0.0, 0.0, 0.0), "unit norm"),
        ((0.55, 0.0, 0.25), DOWN, "jumps by 100 mm"),
        (HOME, (1.0, 0.0, 0.0, 0.0), "jumps by 0 mm and 3.14 rad"),
    ],
)
def test_malformed_commands_and_jumps_latch(place: tuple, turned: tuple, word: str) -> None:
    guard = armed()
    line = guard.command(place, turned, 0, 0)
    assert line is not None and word in line and guard.mode is Mode.FAULT and word in guard.line


@pytest.mark.parametrize(
    ("stamp", "word"), [(-101 * MS, "0.101 s old"), (21 * MS, "in the future"), (0, "goes back by 0.000 s")]
)
def test_stamps_out_of_time_are_ignored_and_counted(stamp: int, word: str) -> None:
    guard = armed()
    assert guard.command(HOME, DOWN, 0, 0) is None
    line = guard.command((0.46, 0.0, 0.25), DOWN, stamp, 0)
    assert line is not None and word in line
    assert guard.mode is Mode.MOVING and sum(guard.counts.values()) == 1


def test_an_old_stream_cannot_keep_the_arm_alive() -> None:
    guard = armed()
    assert guard.command(HOME, DOWN, 0, 0) is None
    for k in range(1, 70):
        guard.command(HOME, DOWN, k * PERIOD - 150 * MS, k * PERIOD)  # always 150 ms late
        guard.tick(k * PERIOD)
    assert guard.mode is Mode.FAULT


def test_a_finished_stream_waits_without_a_fault() -> None:
    guard = armed()
    now, _ = drive(guard, 0, (0.001, 0.0, 0.0), 50)
    guard.finish()
    _, seen = silent(guard, now, 200)
    assert guard.mode is Mode.HOLDING and guard.at_rest and seen[-1].position[0] == pytest.approx(0.5)


def test_a_burst_of_ticks_does_not_hurry() -> None:
    guard = armed()
    for k in range(100):
        guard.command((0.45 + 0.002 * k, 0.0, 0.25), DOWN, k, k)
        guard.tick(k)  # a hundred ticks within 100 ns
    assert guard.setpoint is not None
    assert guard.setpoint.position[0] - 0.45 < 0.002 / (guard.bounds.first * guard.bounds.second) + 1e-12


def test_an_arm_that_does_not_follow_is_a_fault() -> None:
    guard = armed()
    guard.measured(np.array(HOME) + (0.079, 0.0, 0.0), DOWN)
    assert guard.mode is Mode.HOLDING
    guard.measured(np.array(HOME) + (0.081, 0.0, 0.0), DOWN)
    assert guard.mode is Mode.FAULT and "81 mm" in guard.line
    guard = armed()
    guard.measured(np.array([math.nan, 0.0, 0.0]), DOWN)
    assert guard.mode is Mode.FAULT


def test_a_process_that_was_held_up_while_the_arm_moves_stops_it() -> None:
    """The arm's own controller has stopped by then; set-points that went on at full speed would be a jump for it."""
    guard, way, seen = armed(), np.array([0.05, 0.0, 0.0]), []
    for k in range(60):
        now = k * PERIOD
        assert guard.command(HOME + way * (k / 125), DOWN, now, now) is None
        seen.append(guard.tick(now))
    assert guard.setpoint is not None and guard.setpoint.velocity[0] > 0.03
    later = 59 * PERIOD + 1_300_000_000
    assert guard.command(HOME + way, DOWN, later, later) is None
    seen += [guard.tick(later + k * PERIOD) for k in range(60)]
    assert guard.mode is Mode.FAULT and "no set-point for 1.300 s while moving" in guard.line
    assert guard.at_rest and not broken(measure([s for s in seen if s is not None], guard.config))
    still = armed()
    still.tick(0)
    still.tick(5_000_000_000)
    assert still.mode is Mode.HOLDING, "at rest it may take its time"


def test_armed_only_inside_the_limits() -> None:
    guard = Guard(GuardConfig())
    assert guard.tick(0) is None
    with pytest.raises(InputError, match=r"outside the limits \(workspace\)"):
        guard.arm((0.45, 0.0, 0.01), DOWN)
    with pytest.raises(InputError, match=r"outside the limits \(tilt\)"):
        guard.arm(HOME, orientation.UP)
    with pytest.raises(InputError, match="not finite"):
        guard.arm((math.nan, 0.0, 0.2), DOWN)
    guard.arm(HOME, DOWN)
    with pytest.raises(InputError, match="cannot arm"):
        guard.arm(HOME, DOWN)


def test_limits_that_contradict_each_other_are_refused() -> None:
    for change, word in (
        ({"x_low": 0.8}, "box is empty"),
        ({"clearance": 0.5, "table": 0.3}, "box is empty"),
        ({"fault_after": 0.1}, "fault_after"),
        ({"angular_speed": 6.0}, "too small for angular_speed"),
        ({"acceleration": 0.02}, "more than 5 s to stop"),
    ):
        with pytest.raises(ConfigError, match=word):
            bounds_of(dataclasses.replace(GuardConfig(), **change))

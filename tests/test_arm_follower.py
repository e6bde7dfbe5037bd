"""Plans: sampled in position and rotation, taken whole or refused with one line."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from arm_cases import DOWN, HOME, armed, broken, measure

from pred_core.arm import orientation
from pred_core.arm.follower import Follower, Plan, make_plan
from pred_core.arm.guard import Mode
from pred_core.arm.limits import GuardConfig
from pred_core.errors import InputError

CONFIG = GuardConfig()
NS = 10**9
HERE = (np.array(HOME), DOWN)


def plan_of(start: int = 0, first: float = 0.0, seconds: float = 1.0, **changes: Any) -> Plan:
    """From HOME along x at 0.1 m/s for `seconds`, yaw at 0.5 rad/s, one point each 0.1 s; then 0.2 s of rest."""
    times = first + 0.1 * np.arange(round(10 * seconds) + 1)
    position = HOME + np.outer(times - first, (0.1, 0.0, 0.0))
    rotation = np.array(
        [orientation.multiply(orientation.from_rotation_vector((0, 0, 0.5 * (t - first))), DOWN) for t in times]
    )
    times, position, rotation = (
        np.append(times, times[-1] + 0.2),
        np.vstack((position, position[-1])),
        np.vstack((rotation, rotation[-1])),
    )
    values: dict[str, Any] = {"frame": "world", "times": times, "position": position, "rotation": rotation, **changes}
    return make_plan(start, values["frame"], values["times"], values["position"], values["rotation"], CONFIG)


def test_position_and_rotation_between_two_points() -> None:
    plan = plan_of()
    position, rotation = plan.at(250_000_000)  # half way from 0.2 to 0.3 s
    assert position == pytest.approx((0.475, 0.0, 0.25))
    assert orientation.angle_between(DOWN, rotation) == pytest.approx(0.125)
    assert plan.at(-5)[0] == pytest.approx(HOME) and plan.at(9 * NS)[0] == pytest.approx((0.55, 0.0, 0.25))
    assert (plan.begin, plan.end, plan.ends_at_rest) == (0, 1_200_000_000, True)


def points(**changes: Any) -> dict[str, Any]:
    """Three points, 1 mm apart."""
    position = np.array([HOME, (0.451, 0.0, 0.25), (0.452, 0.0, 0.25)])
    return {"times": [0.0, 0.1, 0.2], "position": position, "rotation": np.tile(DOWN, (3, 1)), **changes}


def with_value(name: str, index: tuple[int, int], value: float) -> dict[str, Any]:
    """The three points with one value changed."""
    changed = points()
    changed[name][index] = value
    return changed


@pytest.mark.parametrize(
    ("values", "word"),
    [
        (points(frame="base_link"), "another frame; got 'base_link'; allowed: 'world'"),
        (points(times=[], position=np.zeros((0, 3)), rotation=np.zeros((0, 4))), "too few points; got 0"),
        (points(times=[0.1], position=np.zeros((1, 3)), rotation=np.tile(DOWN, (1, 1))), "too few points; got 1"),
        (points(times=[0.0, 0.2, 0.1]), "do not increase"),
        (points(times=[0.0, 0.1, 0.1]), "do not increase"),
        (points(times=[-0.1, 0.1, 0.2]), "do not increase"),
        (points(times=[0.0, math.nan, 0.2]), "not finite"),
        (with_value("position", (1, 2), math.inf), "not finite"),
        (with_value("rotation", (2, 1), math.nan), "not finite"),
        (with_value("rotation", (2, 1), 0.9), "without unit norm"),
        (with_value("rotation", (2, 1), 1e200), "without unit norm"),
        (with_value("position", (1, 1), 0.2), "jumps after point 0; got 200.0 mm"),
        (points(rotation=np.array([DOWN, DOWN, (0.0, 0.0, 1.0, 0.0)])), "jumps after point 1"),
        (points(position=np.zeros((2, 3))), "one pose per point"),
        (points(position=points()["position"] - (0.0, 0.0, 0.24)), "leaves the workspace at point 0; got [0.45, 0.0,"),
    ],
)
def test_plans_that_are_refused_with_one_line(values: dict[str, Any], word: str) -> None:
    with pytest.raises(InputError) as error:
        plan_of(**values)
    assert word in str(error.value) and "\n" not in str(error.value)


def test_a_plan_must_begin_where_the_arm_will_be() -> None:
    follower = Follower(CONFIG, lifetime=3.0)
    away = (np.array(HOME) + (0.0, 0.06, 0.0), DOWN)
    with pytest.raises(InputError, match="60 mm, 0.00 rad away"):
        follower.accept(plan_of(), away, 0)
    follower.accept(plan_of(first=0.1), away, 0)  # 0.1 s at 0.25 m/s more: within 75 mm
    with pytest.raises(InputError, match="200 mm, 0.00 rad away.*allowed: 81 mm"):  # it stops within 0.125 s
        follower = Follower(CONFIG, lifetime=3.0)
        follower.accept(plan_of(first=1.0), (np.array(HOME) + (0.0, 0.2, 0.0), DOWN), 0)
    with pytest.raises(InputError, match="too far ahead; got 3.100 s; allowed: 3 s"):
        follower.accept(plan_of(start=2_500_000_000, first=0.6), HERE, 0)
    follower.accept(plan_of(start=2_500_000_000, first=0.4), HERE, 0)
    with pytest.raises(InputError, match="lies in the past; got it ended 0.100 s ago"):
        follower.accept(plan_of(), HERE, 1_300_000_000)


def test_a_plan_that_would_be_cut_off_is_refused_and_one_that_just_fits_is_followed_to_its_end() -> None:
    """The lifetime is 3 s from the stamp; the last point comes 0.2 s after the motion."""
    follower = Follower(CONFIG, lifetime=3.0)
    with pytest.raises(InputError, match="too long; got 3.200 s from its stamp.*allowed: 3 s.*lifetime:=4.0"):
        follower.accept(plan_of(first=2.0), HERE, 0)
    follower.accept(plan_of(first=1.8), HERE, 0)  # ends at 3.0 s
    target = follower.target(3 * NS, 0.0)
    assert target is not None and target[0] == pytest.approx((0.55, 0.0, 0.25)) and follower.done(3 * NS)


def test_the_next_plan_waits_for_its_time() -> None:
    follower = Follower(CONFIG, lifetime=3.0)
    first = plan_of()
    follower.accept(first, HERE, 0)
    position = first.position + (0.0, 0.01, 0.0)
    follower.accept(make_plan(0, "world", first.times + 0.5, position - (-0.05, 0, 0), first.rotation, CONFIG), HERE, 0)
    before, after = follower.target(400_000_000, 0.0), follower.target(500_000_000, 0.0)
    assert before is not None and after is not None
    assert before[0] == pytest.approx((0.49, 0.0, 0.25)) and after[0] == pytest.approx((0.50, 0.01, 0.25))


def test_what_runs_out_asks_for_nothing() -> None:
    follower = Follower(CONFIG, lifetime=3.0)
    assert follower.target(0, 0.0) is None
    moving = make_plan(0, "world", [0.0, 1.0], np.array([HOME, (0.55, 0.0, 0.25)]), np.tile(DOWN, (2, 1)), CONFIG)
    follower.accept(moving, HERE, 0)
    assert follower.target(NS, 0.0) is not None and follower.target(NS + 1, 0.0) is None
    assert follower.target(NS - 10**8, 0.2) is None and not follower.done(2 * NS)
    follower.clear()
    follower.accept(plan_of(), HERE, 0)
    assert follower.target(NS + 10**8, 0.2) is not None  # ends at rest: it may wait there
    assert not follower.done(1_199_999_999) and follower.done(1_200_000_000)


def test_with_the_guards_lag_as_lead_the_arm_is_on_time() -> None:
    guard, follower = armed(CONFIG), Follower(CONFIG, lifetime=3.0)
    plan = plan_of(first=0.3)
    follower.accept(plan, HERE, 0)
    errors, seen = [], []
    for k in range(1, 240):
        now = k * 8_000_000
        if follower.done(now):
            guard.finish()
            follower.clear()
        target = follower.target(now, guard.bounds.lag)
        if target is not None:
            assert guard.command(*target, now, now) is None
        setpoint = guard.tick(now)
        assert setpoint is not None
        seen.append(setpoint)
        errors.append(float(np.linalg.norm(setpoint.position - plan.at(now)[0])))
    # On a straight line the averages only shift in time, and the lead takes the shift back: within one tick's way.
    assert max(errors[90:130]) < 0.1 * 0.008
    # At the corners, 0 to 0.1 m/s: at most half of speed x lag.
    assert max(errors) < 0.5 * 0.1 * guard.bounds.lag
    assert guard.mode is Mode.HOLDING and guard.at_rest and errors[-1] < 1e-12
    assert not broken(measure(seen, CONFIG))

"""MPPI and the planner: the optimum of a known world, warm start, deadline, latency, and what they refuse."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from plan_cases import DOWN, HOME, Rigid, line_points, seen, settings

from pred_core.errors import DivergenceError, InputError
from pred_core.plan.config import SearchConfig
from pred_core.plan.costs import Objective
from pred_core.plan.curve import Curve
from pred_core.plan.goal_cost import GoalCost
from pred_core.plan.knots import Beginning
from pred_core.plan.latency import departure, tracking_error
from pred_core.plan.motion_costs import SmoothnessCost
from pred_core.plan.plan import Plan, check_plan
from pred_core.plan.planner import Planner
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.search import draw_noise, move_mean, weigh

MOVE = np.array([0.2, -0.1, 0.1])  # [m]


def planner(goal: np.ndarray, seed: int = 0, dynamics: Rigid | None = None, watch=None, clock=None, **search: float):
    objective = Objective([GoalCost(goal, None, 1.0, 2.0), SmoothnessCost(0.001)])
    extra = {} if clock is None else {"clock": clock}
    config = settings(**search)
    return Planner(dynamics or Rigid(), objective, config, np.random.default_rng(seed), watch=watch, **extra)


def end_of(plan: Plan) -> np.ndarray:
    return plan.curve.displacement(np.array([plan.curve.seconds]))[0, 0]


def test_weights_prefer_low_costs_and_do_not_depend_on_scale_or_shift() -> None:
    costs = np.array([3.0, 1.0, 2.0, np.inf, np.nan])
    # Median of the finite less least is 1: exp(0), exp(-1 / 0.5), exp(-2 / 0.5) at temperature 0.5.
    expected = np.exp([-4.0, 0.0, -2.0])
    assert weigh(costs, 0.5)[:3] == pytest.approx(expected / expected.sum())
    assert weigh(costs, 0.5)[3:].tolist() == [0.0, 0.0]
    assert weigh(1e4 * costs - 7.0, 0.5) == pytest.approx(weigh(costs, 0.5))
    assert weigh(np.array([2.0, 2.0, 2.0]), 0.1).tolist() == pytest.approx([1 / 3] * 3)
    with pytest.raises(DivergenceError, match="none of 2"):
        weigh(np.array([np.inf, np.nan]), 0.1)


def test_noise_has_the_variance_and_correlation_asked_for() -> None:
    config = SearchConfig(noise=0.2, turn_noise=0.7, correlation=0.6, finest=1.0, shrink=0.5)
    noise = draw_noise(config, (6, 20_000, 1, 4), 0, np.random.default_rng(0))
    assert np.abs(noise[:, 0]).max() == 0.0
    # 20,000 samples: standard errors of 0.5 % of a deviation and 0.7 % of a correlation.
    assert noise[:, 1:, 0, :3].std(axis=1) == pytest.approx(np.full((6, 3), 0.2), rel=0.03)
    assert noise[:, 1:, 0, 3].std(axis=1) == pytest.approx(np.full(6, 0.7), rel=0.03)
    assert np.corrcoef(noise[3, 1:, 0, 0], noise[4, 1:, 0, 0])[0, 1] == pytest.approx(0.6, abs=0.03)
    assert draw_noise(config, (6, 20_000, 1, 4), 2, np.random.default_rng(0)) == pytest.approx(0.25 * noise)


def test_mppi_alone_reaches_the_minimum_of_a_quadratic() -> None:
    """Known optimum without any Dynamics: the mean must fall towards it, here by 30 times in 25 iterations."""
    optimum = np.random.default_rng(1).normal(size=(4, 1, 4)) * 0.2
    config = SearchConfig(noise=0.2, turn_noise=0.2, correlation=0.0, shrink=0.9)
    generator, mean = np.random.default_rng(0), np.zeros((4, 1, 4))
    begin = np.linalg.norm(mean - optimum)
    for i in range(25):
        samples = mean[:, None] + draw_noise(config, (4, 256, 1, 4), i, generator)
        costs = ((samples - optimum[:, None]) ** 2).sum(axis=(0, 2, 3))
        mean = move_mean(samples, costs, config.temperature)
    assert np.linalg.norm(mean - optimum) < begin / 30


def test_planner_reaches_the_goal_of_a_rigid_object() -> None:
    goal = line_points() + MOVE
    plan = planner(goal, samples=64, iterations=20).plan(seen())
    # The object moves with the gripper: the optimum is a displacement of MOVE at the end. Samples have a spread of
    # 0.25 x 0.25 x 0.85^20 x 0.25 m/s in the end: millimetres; the cost is flat along the line (2 cm of spacing).
    assert end_of(plan)[:3] == pytest.approx(MOVE, abs=0.012)
    assert GoalCost(goal, None, 0.0, 1.0).distance(torch.tensor(plan.predicted[-1]).float()).item() < 0.02
    assert plan.cost < 0.25 * plan.still
    assert plan.motions == 64 * 20 and plan.iterations == 20


def test_planner_turns_a_rigid_object() -> None:
    yaw = 0.8
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    goal = (line_points() - HOME) @ turn.T + HOME
    plan = planner(goal, samples=64, iterations=20).plan(seen())
    assert end_of(plan)[3] == pytest.approx(yaw, abs=0.12)
    assert np.linalg.norm(end_of(plan)[:3]) < 0.012
    # Predicted with the same turn: the last particle, 10 cm from the gripper, is where the goal has it.
    assert np.linalg.norm(plan.predicted[-1][-1] - goal[-1]) < 0.02


def test_more_time_never_makes_the_plan_worse() -> None:
    plan = planner(line_points() + MOVE).plan(seen())
    costs = [cost for _, cost in plan.history]
    assert len(costs) == 6 * 2  # two chunks an iteration
    assert all(b <= a for a, b in zip(costs[:-1], costs[1:], strict=True))
    assert costs[-1] == plan.cost <= plan.still


def test_same_seed_same_plan() -> None:
    plans = [planner(line_points() + MOVE, seed=3).plan(seen()) for _ in range(2)]
    assert np.array_equal(plans[0].curve.knots, plans[1].curve.knots)
    assert not np.array_equal(plans[0].curve.knots, planner(line_points() + MOVE, seed=4).plan(seen()).curve.knots)


def test_warm_start_helps() -> None:
    """Replanned 0.2 s later with one iteration: from the last plan against from nothing, over ten seeds."""
    warm, cold = [], []
    for seed in range(10):
        one = planner(line_points() + MOVE, seed=seed, iterations=1)
        many = planner(line_points() + MOVE, seed=seed, iterations=8)
        first = many.plan(seen())
        later = 200_000_000
        # The rigid object follows the plan exactly: what is seen later is the plan's own pose.
        moved = first.at(later).position[0] - HOME[0]
        now = seen(later, offset=tuple(moved.tolist()))
        yaw_free = dataclasses.replace(now, rotation=first.at(later).rotation)
        cold.append(one.plan(yaw_free, in_force=first).cost)
        one._last = first
        warm.append(one.plan(yaw_free, in_force=first).cost)
    assert np.mean(warm) < 0.7 * np.mean(cold)
    assert sum(w < c for w, c in zip(warm, cold, strict=True)) >= 9


def test_reset_forgets_the_last_plan() -> None:
    fresh = planner(line_points() + MOVE, seed=0)
    fresh.plan(seen())
    fresh.reset()
    assert np.abs(fresh._first_guess(0, 1)).max() == 0.0


class Clock:
    """Time that passes by a fixed amount with every simulated chunk."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize(("budget", "chunks"), [(0.02, 1), (0.10, 2), (0.26, 5), (9.0, 12)])
def test_deadline_is_kept_to_the_chunk(budget: float, chunks: int) -> None:
    """A chunk takes 50 ms here: as many as fit are tried, at least one; the plan is never late by another."""
    clock, tried = Clock(), []

    def watch(rollouts: Rollouts, costs: np.ndarray) -> None:
        clock.now += 0.05
        tried.append(len(costs))

    one = planner(line_points() + MOVE, watch=watch, clock=clock)
    plan = one.plan(seen(), deadline=100.0 + budget)
    assert len(tried) == chunks and plan.motions == 16 * chunks
    assert plan.seconds <= max(budget, 0.05) + 1e-9


def test_deadline_of_the_next_plan_knows_how_long_a_chunk_took() -> None:
    clock = Clock()

    def watch(rollouts: Rollouts, costs: np.ndarray) -> None:
        clock.now += 0.05

    one = planner(line_points() + MOVE, watch=watch, clock=clock)
    one.plan(seen(), deadline=100.11)
    begun = clock.now
    plan = one.plan(seen(), deadline=begun + 0.13)
    assert plan.motions == 32 and clock.now - begun == pytest.approx(0.1)


def test_plan_begins_from_the_state_at_its_start() -> None:
    """Latency compensation: the object drifts with 0.1 m/s; a plan due 0.3 s later starts 3 cm further on."""
    dynamics = Rigid(drift=(0.1, 0.0, 0.0))
    start = departure(dynamics, seen(stamp=5_000_000_000), 5_300_000_000, None)
    assert start.stamp == 5_300_000_000
    assert start.state.position[0].tolist() == pytest.approx([0.03, 0.0, 0.3], abs=1e-6)
    assert start.beginning.position == pytest.approx(HOME)
    # A goal exactly where it will be by then and no drift after that costs nothing but the drift: compare both.
    still = Rigid(drift=(0.1, 0.0, 0.0))
    goal = line_points() + [0.03 + 0.1 * 1.2, 0.0, 0.0]
    plan = planner(goal, dynamics=still, samples=64, iterations=12).plan(seen(), 300_000_000)
    assert plan.start == 300_000_000
    assert end_of(plan)[0] == pytest.approx(0.0, abs=0.02)  # the drift alone brings it there


def test_departure_follows_the_plan_in_force() -> None:
    knots = np.zeros((8, 1, 4))
    knots[:, 0, 0] = 0.2  # 0.2 m/s along x throughout
    curve = Curve(0.2, HOME, DOWN, knots)
    force = Plan(0, curve, curve, 0.0, {}, 0.0, np.zeros((1, 6, 3)), np.zeros(1), 0, 0, 0.0, 1)
    at = seen(stamp=100_000_000, offset=(0.015, 0.0, 0.0))  # the plan has it at 2 cm: 5 mm behind
    start = departure(Rigid(), at, 400_000_000, force)
    assert tracking_error(at, force) == pytest.approx(0.005)
    # At 0.4 s the plan is at 8 cm; the rigid object has gone with the gripper from 1.5 cm to there.
    assert start.beginning.position[0] == pytest.approx([0.08, 0.0, 0.3])
    assert start.beginning.velocity[0] == pytest.approx([0.2, 0, 0, 0])
    assert start.state.position[0].tolist() == pytest.approx([0.08, 0.0, 0.3], abs=1e-6)


def test_consecutive_plans_join_without_a_jump() -> None:
    one = planner(line_points() + MOVE)
    first = one.plan(seen())
    later = 250_000_000
    second = one.plan(seen(), later, in_force=first)
    before, after = first.at(second.start), second.at(second.start)
    assert after.position == pytest.approx(before.position, abs=1e-12)
    assert after.velocity == pytest.approx(before.velocity, abs=1e-9)
    assert after.acceleration == pytest.approx(before.acceleration, abs=1e-9)


def test_a_sent_plan_ends_at_rest_and_says_where() -> None:
    plan = planner(line_points() + MOVE).plan(seen())
    times, position, rotation = plan.points(0.02)
    assert (np.diff(times) > 0).all() and np.abs(np.diff(times) - np.diff(times)[0]).max() < 0.005
    assert position[-1] == pytest.approx(position[-2]) and rotation[-1] == pytest.approx(rotation[-2])
    assert np.linalg.norm(rotation, axis=-1) == pytest.approx(np.ones(rotation.shape[:-1]))
    far = plan.at(plan.end + 10**9)
    assert far.position == pytest.approx(position[-1]) and np.abs(far.velocity).max() == 0.0


def test_motions_that_diverge_are_avoided_and_all_diverging_is_said() -> None:
    """A wall of divergence 6 cm ahead: the plan stays on this side although the goal is beyond it."""
    ahead = line_points() + [0.2, 0.0, 0.0]
    reach = 0.02 * 5 + 0.06  # [m] the foremost particle may get this far
    plan = planner(ahead, dynamics=Rigid(wall=reach)).plan(seen())
    assert plan.predicted[..., 0].max() <= reach and plan.cost < plan.still
    with pytest.raises(DivergenceError, match="could be simulated"):
        planner(ahead, dynamics=Rigid(wall=0.05)).plan(seen())


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"position": np.array([[np.nan, 0.0, 0.3]])}, "gripper pose is not finite"),
        ({"position": np.zeros((0, 3)), "rotation": np.zeros((0, 4))}, "held gripper index; got 0"),
    ],
)
def test_a_bad_gripper_is_refused(change: dict, line: str) -> None:
    with pytest.raises(InputError, match=line):
        dataclasses.replace(seen(), **change).check(6)


def test_a_bad_state_is_refused() -> None:
    good = seen()
    broken = good.state.position.clone()
    broken[3, 1] = torch.nan
    with pytest.raises(InputError, match=r"state is not finite; got particles \[3\]"):
        dataclasses.replace(good, state=good.state.replace(position=broken)).check(6)
    with pytest.raises(InputError, match="does not fit the twin"):
        good.check(7)
    with pytest.raises(InputError, match="no gripper holds the object"):
        dataclasses.replace(good, state=good.state.replace(held=torch.full((6,), -1))).check(6)


def test_a_plan_with_a_jump_is_refused() -> None:
    config = settings()
    here = Beginning(HOME, DOWN, np.zeros((1, 4)), np.zeros((1, 4)))
    curve = planner(line_points() + MOVE).plan(seen()).curve
    check_plan(curve, here, config)
    with pytest.raises(InputError, match="begins with a jump; got 50 mm"):
        check_plan(dataclasses.replace(curve, start=HOME + [0.05, 0.0, 0.0]), here, config)
    turned = np.array([[np.cos(0.2), 0.0, 0.0, np.sin(0.2)]])
    with pytest.raises(InputError, match=r"begins with a jump; got 0 mm, 0\.40 rad"):
        check_plan(dataclasses.replace(curve, rotation=turned), here, config)
    leap = curve.knots.copy()
    leap[4, 0, 0] = 3.0
    with pytest.raises(InputError, match="the plan jumps; got"):
        check_plan(dataclasses.replace(curve, knots=leap), here, config)
    with pytest.raises(InputError, match="not finite"):
        check_plan(dataclasses.replace(curve, knots=curve.knots * np.nan), here, config)
    narrow = dataclasses.replace(config, motion=dataclasses.replace(config.motion, x_high=0.05))
    with pytest.raises(InputError, match="leaves the workspace; got"):
        check_plan(curve, here, narrow)

"""Planned motions: the spline's derivatives, its beginning and end, and the limits every sample keeps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plan_cases import BOX, DOWN, HOME

from pred_core.errors import ConfigError
from pred_core.plan.config import MotionConfig
from pred_core.plan.curve import Curve, displacement_weights, first_knots, resting, turned
from pred_core.plan.knots import KnotLimits

MOTION = MotionConfig(horizon=1.6, knots=8, speed=0.3, acceleration=2.0, turn_speed=1.0, turn_acceleration=5.0, **BOX)


def random_curve(seed: int = 0) -> Curve:
    return Curve(0.2, HOME, DOWN, np.random.default_rng(seed).normal(size=(10, 1, 4)))


def test_velocity_and_acceleration_are_the_derivatives() -> None:
    curve, h = random_curve(), 1e-4
    times = np.linspace(0.05, 1.55, 97)  # between knots as well as near them
    forward, backward = curve.displacement(times + h), curve.displacement(times - h)
    # Central differences of a cubic: error h^2/6 |p'''| <= 1e-8 / 6 * 100 in velocity.
    assert np.abs((forward - backward) / (2 * h) - curve.velocity(times)).max() < 1e-6
    change = (curve.velocity(times + h) - curve.velocity(times - h)) / (2 * h)
    inside = np.abs(times / 0.2 - np.round(times / 0.2)) > 2 * h / 0.2  # the acceleration has corners at knots
    assert np.abs(change - curve.acceleration(times))[inside].max() < 1e-6


def test_a_constant_velocity_covers_velocity_times_time() -> None:
    knots = np.zeros((10, 1, 4))
    knots[..., 0] = 0.25
    # 0.25 m/s for 1.3 s: 0.325 m.
    assert Curve(0.2, HOME, DOWN, knots).displacement(np.array([1.3]))[0, 0, 0] == pytest.approx(0.325, abs=1e-12)


def test_the_beginning_has_the_velocity_and_acceleration_asked_for() -> None:
    velocity, acceleration = np.array([[0.1, -0.2, 0.05, 0.3]]), np.array([[1.0, 0.5, -0.7, 2.0]])
    knots = np.zeros((10, 1, 4))
    knots[:2] = first_knots(velocity, acceleration, 0.2)
    curve = Curve(0.2, HOME, DOWN, knots)
    assert curve.velocity(np.array([0.0]))[0] == pytest.approx(velocity, abs=1e-12)
    assert curve.acceleration(np.array([0.0]))[0] == pytest.approx(acceleration, abs=1e-12)
    assert curve.poses(np.array([0.0]))[0][0] == pytest.approx(HOME)


def test_kept_weights_are_those_of_the_curve() -> None:
    curve, times = random_curve(), np.array([0.0, 0.31, 1.6])
    weights = displacement_weights(times, 8, 0.2)
    assert np.tensordot(weights, curve.knots, axes=1) == pytest.approx(curve.displacement(times), abs=1e-12)


def test_stopping_keeps_the_part_before_and_ends_at_rest() -> None:
    curve = random_curve()
    stopped = curve.stopping(0.6)
    times = np.linspace(0.0, 0.6, 31)
    assert stopped.displacement(times) == pytest.approx(curve.displacement(times), abs=1e-12)
    # 0.6 s are three segments; two more bring it to rest: 1.0 s in all.
    assert stopped.seconds == pytest.approx(1.0)
    assert np.abs(stopped.velocity(np.array([1.0]))).max() < 1e-12
    assert np.abs(stopped.acceleration(np.array([1.0 - 1e-9]))).max() < 1e-6 + np.abs(stopped.knots[-3]).max() / 0.2


def test_yaw_turns_about_world_z() -> None:
    # A quarter turn: x -> y. From the tilt (0, 1, 0, 0) (half a turn about x) the quaternion is (0, c, c, 0).
    c = np.sqrt(0.5)
    assert turned(np.array([0.0, 1.0, 0.0, 0.0]), np.array(np.pi / 2)) == pytest.approx([0.0, c, c, 0.0], abs=1e-12)


def test_resting_does_not_move() -> None:
    assert np.abs(resting(HOME, DOWN, 0.1).displacement(np.linspace(0, 1, 5))).max() == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_every_sample_keeps_speed_acceleration_box_and_rest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = KnotLimits(MOTION)
    velocity = np.array([[0.2, 0.0, -0.1, 0.5]])
    samples = rng.normal(size=(limits.free, 300, 1, 4)) * rng.choice([0.1, 1.0, 30.0])
    knots = limits.apply(samples, first_knots(velocity, np.zeros((1, 4)), limits.spacing), HOME)
    times = np.linspace(0.0, 1.6, 161)
    for k in range(0, 300, 7):
        curve = Curve(limits.spacing, HOME, DOWN, knots[:, k])
        moved, fast, strong = curve.displacement(times), curve.velocity(times), curve.acceleration(times)
        assert np.linalg.norm(fast[..., :3], axis=-1).max() <= 0.3 * (1 + 1e-9)
        assert np.abs(fast[..., 3]).max() <= 1.0 + 1e-9
        assert np.linalg.norm(strong[..., :3], axis=-1).max() <= 2.0 * (1 + 1e-9)  # the box is out of reach here
        assert np.abs(strong[..., 3]).max() <= 5.0 * (1 + 1e-9)
        assert np.abs(fast[-1]).max() < 1e-12
        assert (HOME + moved[:, 0, :3] >= [-1, -1, 0]).all() and (HOME + moved[:, 0, :3] <= 1).all()


def test_the_box_is_a_wall_and_a_start_outside_goes_no_farther() -> None:
    limits = KnotLimits(dataclasses.replace(MOTION, x_high=0.05))
    push = np.zeros((limits.free, 2, 1, 4))
    push[..., 0] = 10.0
    still = first_knots(np.zeros((1, 4)), np.zeros((1, 4)), limits.spacing)
    times = np.linspace(0, 1.6, 81)
    x = Curve(0.2, HOME, DOWN, limits.apply(push, still, HOME)[:, 0]).poses(times)[0][:, 0, 0]
    assert x.max() == pytest.approx(0.05, abs=1e-9)
    outside = HOME + [0.2, 0.0, 0.0]
    x = Curve(0.2, outside, DOWN, limits.apply(push, still, outside)[:, 0]).poses(times)[0][:, 0, 0]
    assert x.max() <= 0.2 + 1e-9 and x.min() > 0.19


def test_an_empty_box_is_refused() -> None:
    with pytest.raises(ConfigError, match="workspace box is empty"):
        KnotLimits(dataclasses.replace(MOTION, z_low=0.5, z_high=0.4))

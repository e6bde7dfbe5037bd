"""Tilt and yaw: an exact chart of the rotations, whose derivatives bound those of the rotation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pred_core import frames
from pred_core.arm import orientation
from pred_core.arm.orientation import DOWN, UP, from_tilt_yaw, multiply, rotation_vector, to_tilt_yaw, wound

H = 1e-3  # [s] of the differences below; their own error is of order H


def test_the_chart_and_its_inverse_agree() -> None:
    rng = np.random.default_rng(0)
    for upright in (UP, DOWN):
        for _ in range(200):
            tilt = rng.normal(size=2)
            tilt *= rng.uniform(0, 3.0) / np.linalg.norm(tilt)
            u = (float(tilt[0]), float(tilt[1]), float(rng.uniform(-3.1, 3.1)))
            q = from_tilt_yaw(u, upright)
            back = to_tilt_yaw(q, upright)
            assert back is not None
            assert math.remainder(back[2] - u[2], 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
            assert back[:2] == pytest.approx(u[:2], abs=1e-9)
            # The tool's z axis makes the angle |tilt| with upright.
            axis = frames.quaternion_rotate(
                torch.tensor(q, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0]).double()
            )
            start = frames.quaternion_rotate(
                torch.tensor(upright, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0]).double()
            )
            assert math.acos(min(1.0, max(-1.0, float(axis @ start)))) == pytest.approx(
                float(np.hypot(*u[:2])), abs=1e-7
            )


def test_upside_down_has_no_yaw() -> None:
    assert to_tilt_yaw(UP, DOWN) is None


def test_products_and_slerp_agree_with_frames() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 4))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    expected = frames.quaternion_multiply(torch.tensor(a), torch.tensor(b)).numpy()
    assert np.abs(np.array(multiply(tuple(a), tuple(b))) - expected).max() < 1e-15
    half = orientation.slerp(tuple(a), tuple(b), 0.5)
    assert orientation.angle_between(tuple(a), half) == pytest.approx(orientation.angle_between(half, tuple(b)))
    assert orientation.angle_between(tuple(b), orientation.slerp(tuple(a), tuple(b), 1.0)) < 1e-7


def test_yaw_takes_the_nearest_turn_within_its_limit() -> None:
    assert wound(3.0, -3.0, 10.0) == pytest.approx(3.0 - 2 * math.pi)
    assert wound(3.0, -3.0, 3.2) == pytest.approx(3.0)  # nearer, but beyond the limit
    assert wound(3.0, 0.0, 1.0) == 1.0  # no such yaw within the limit: its edge


def test_the_constants_of_the_angular_limits_hold() -> None:
    """Angular acceleration <= sqrt 2 A + 0.75 V^2, jerk <= sqrt 2 J + 2.5 A V + 0.75 V^3 for tilts up to 1.4 rad."""
    rng = np.random.default_rng(2)
    most = {"speed": 0.0, "V^2": 0.0, "V^3": 0.0, "A V": 0.0}

    def rates(u: np.ndarray, d: np.ndarray, e: np.ndarray) -> list[np.ndarray]:
        """Angular velocity in four intervals along u + d t + e t^2 / 2."""
        q = [from_tilt_yaw(tuple(u + d * t + 0.5 * e * t * t), UP) for t in H * np.arange(-2, 3)]
        steps = zip(q[1:], q[:-1], strict=True)
        return [np.array(rotation_vector(multiply(b, orientation.conjugate(a)))) / H for b, a in steps]

    for _ in range(1500):
        tilt, d, e = rng.normal(size=2), rng.normal(size=3), rng.normal(size=3)
        u = np.append(1.4 * tilt / np.linalg.norm(tilt) * rng.random() ** 0.3, 0.0)
        d, e = d / np.linalg.norm(d), e / np.linalg.norm(e)
        w = rates(u, d, 0.0 * e)
        jerk = ((w[3] - w[2]) - (w[1] - w[0])) / (2 * H * H)
        bent = rates(u, d, e)
        bent_jerk = ((bent[3] - bent[2]) - (bent[1] - bent[0])) / (2 * H * H)
        found = (w[1], (w[2] - w[1]) / H, jerk, bent_jerk - jerk)
        for name, value in zip(most, found, strict=True):
            most[name] = max(most[name], float(np.linalg.norm(value)))
    assert 1.2 < most["speed"] < math.sqrt(2)
    assert 0.5 < most["V^2"] < 0.75 and 0.3 < most["V^3"] < 0.75 and 1.8 < most["A V"] < 2.5, most

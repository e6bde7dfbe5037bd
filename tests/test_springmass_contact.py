"""Surfaces, grippers and self-collision."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from springmass_cases import NOWHERE, holding, line, nobody, particles, state_of, still

from pred_core.frames import quaternion_from_rotation_vector
from pred_core.springmass import SpringMass
from pred_core.springmass.reference import fixture_gap
from pred_core.types import Box, Capsule, Fixture, Grip, Physics, Scene, Sphere

THIN = Box((0.0, 0.0, 0.0), (0.1, 0.0005, 0.1), (math.cos(0.2), math.sin(0.2), 0.0, 0.0))


@pytest.mark.parametrize(
    "fixture", [THIN, Box((0, 0, 0), (0.05, 0.02, 0.03)), Capsule((-0.05, 0, 0), (0.05, 0.02, 0), 0.002),
                Sphere((0, 0, 0), 0.003)],
)  # fmt: skip
def test_nothing_tunnels_through_a_fixture_at_two_metres_a_second(fixture: Fixture) -> None:
    rng = np.random.default_rng(0)
    # 200 particles on a sphere of 0.2 m fly at the fixture's middle; one substep at 2 m/s is 20 mm, its size 1 to 6 mm.
    way = rng.normal(size=(200, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    body = particles(0.2 * way, radius=0.001)
    sim = SpringMass(body, Physics(ground_friction=0.0), Scene(gravity=(0, 0, 0), fixtures=(fixture,)), substeps=1)
    state = state_of(body.rest_position, -2.0 * way)
    x = sim.rollout(sim.start(state), nobody(30))
    path = torch.cat((state.position[None], x)).double()
    between = torch.linspace(0, 1, 21, dtype=torch.float64)[:, None, None, None]
    along = path[:-1] + between * (path[1:] - path[:-1])  # every piece of the way, in steps of 1 mm
    gap, _ = fixture_gap(fixture, along)
    assert float(gap.min()) > 0.001 - 1e-5  # float32 of 0.2 m, a few roundings
    assert float(gap.min()) < 0.0011  # and they did arrive


def test_nothing_tunnels_through_the_ground() -> None:
    body = particles(np.array([[0.0, 0, 0.1], [0.1, 0, 0.013]]), radius=0.005)
    sim = SpringMass(body, Physics(), Scene(ground=0.0), substeps=1)
    x = sim.rollout(sim.start(state_of(body.rest_position, np.array([0.5, 0, -2.0]))), nobody(40))
    assert float(x[..., 2].min()) >= 0.005 - 1e-6
    assert float(x[-1, :, 2].max()) == pytest.approx(0.005, abs=1e-6)  # inelastic: it stays


def test_held_particle_follows_a_turning_gripper_on_an_arc() -> None:
    body = particles(np.array([[0.1, 0, 0], [0.5, 0, 0]]))
    sim = SpringMass(body, Physics(), NOWHERE, substeps=100)
    start = sim.start(holding(state_of(body.rest_position), {0: 0}), still(torch.zeros(1, 3)))
    turned = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, 0.5]]))
    after = sim.step(start, Grip(torch.zeros(1, 3), turned, torch.ones(1, dtype=torch.bool)))
    c, s = math.cos(0.5), math.sin(0.5)
    assert torch.allclose(after.position[0], torch.tensor([0.1 * c, 0.1 * s, 0.0]), atol=1e-7)
    # Interpolated quaternions turn at 2 sin(0.25) a period at their end; a backward difference lags half a substep.
    speed = 0.1 * 2 * math.sin(0.25) / 0.01
    assert torch.allclose(after.velocity[0], speed * torch.tensor([-s, c, 0.0]), atol=0.01 * speed)
    # Half way the particle is on the arc, not on the chord (which passes at 0.1 cos 0.25 = 0.0969).
    half = SpringMass(body, Physics(), NOWHERE, period=0.005, substeps=50)
    middle = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, 0.25]]))
    at = half.step(half.start(holding(state_of(body.rest_position), {0: 0}), still(torch.zeros(1, 3))),
                   Grip(torch.zeros(1, 3), middle, torch.ones(1, dtype=torch.bool)))  # fmt: skip
    assert float(at.position[0].norm()) == pytest.approx(0.1, abs=1e-7)


def test_travelling_gripper_gives_its_velocity() -> None:
    body = particles(np.array([[1.0, 2.0, 3.0], [0.5, 0, 0]]))
    sim = SpringMass(body, Physics(), NOWHERE, substeps=500)
    begin = torch.tensor([[1.0, 2.0, 2.9]])
    start = sim.start(holding(state_of(body.rest_position), {0: 0}), still(begin))
    after = sim.step(start, still(begin + torch.tensor([0.003, 0.0, -0.002])))
    # Also with a substep of 20 us: the lever is differenced, not the position, which float32 knows to 2e-7 m.
    assert torch.allclose(after.velocity[0], torch.tensor([0.3, 0.0, -0.2]), atol=1e-4)


def test_close_open_and_regrasp() -> None:
    body = particles(np.array([[0.0, 0, 0], [0.01, 0, 0], [0.3, 0, 0]]))
    sim = SpringMass(body, Physics(), Scene(grasp_radius=0.02), substeps=5)
    origin = torch.zeros(1, 3)
    state = sim.start(state_of(body.rest_position), still(origin, closed=False))
    state = sim.step(state, still(origin))  # closes: takes what is within 2 cm
    assert state.held.tolist() == [0, 0, -1]
    assert torch.allclose(state.position[:2], torch.tensor([[0.0, 0, 0], [0.01, 0, 0]]), atol=1e-7)
    state = sim.step(state, still(origin + 0.05))
    assert torch.allclose(state.position[:2], torch.tensor([[0.05, 0.05, 0.05], [0.06, 0.05, 0.05]]), atol=1e-7)
    state = sim.step(state, still(origin + 0.05, closed=False))  # opens: they fly on at 5 m/s
    assert state.held.tolist() == [-1, -1, -1]
    assert float(state.velocity[0, 0]) == pytest.approx(5.0, rel=1e-3)
    again = still(state.position[:1], closed=False)
    state = sim.start(state, again)
    state = sim.step(state, still(again.position))
    assert state.held.tolist() == [0, 0, -1]
    # A rollout in which the gripper opens and closes is the same as steps.
    closed = torch.tensor([False, True, True, False, False, True])[:, None]
    moving = Grip(torch.linspace(0, 0.02, 6)[:, None, None].expand(6, 1, 3), still(origin, 6).rotation, closed)
    begin = sim.start(state_of(body.rest_position), still(origin, closed=False))
    whole, last = sim.rollout_states(begin, moving)
    now, path = begin, []
    for t in range(6):
        now = sim.step(now, moving.at(t))
        path.append(now.position)
    assert torch.equal(whole, torch.stack(path))
    assert torch.equal(last.held, now.held)


def test_open_gripper_pushes_particles_to_its_surface() -> None:
    grid = np.stack(np.meshgrid(*(np.linspace(-0.03, 0.03, 4),) * 3), axis=-1).reshape(-1, 3)
    body = particles(grid, radius=0.002)
    sim = SpringMass(body, Physics(ground_friction=0.3), Scene(gravity=(0, 0, 0), pusher_radius=0.04), substeps=10)
    begin = torch.tensor([[-0.2, 0.0, 0.0]])
    state = sim.start(state_of(grid), still(begin, closed=False))
    way = torch.linspace(-0.195, 0.0, 40)[:, None, None] * torch.tensor([1.0, 0.0, 0.0])  # 0.5 m/s
    x = sim.rollout(state, Grip(way, still(begin, 40).rotation, torch.zeros(40, 1, dtype=torch.bool)))
    distance = (x - way).norm(dim=-1)
    assert float(distance.min()) > 0.042 - 1e-4  # tangential travel beside a moving curved surface, second order
    assert float((x[-1] - torch.tensor(grid, dtype=torch.float32)).norm(dim=-1).max()) > 0.05
    passing = sim.rollout(state, Grip(way, still(begin, 40).rotation, torch.ones(40, 1, dtype=torch.bool)))
    assert torch.equal(passing[-1], state.position)  # a closed gripper that holds nothing passes


def test_self_collision_keeps_strands_apart() -> None:
    # A line dropped across another that is held at both ends.
    count, radius = 21, 0.006
    lower = line(count, 0.2, mass=0.05, radius=radius)
    upper = lower.rest_position[:, [1, 0, 2]] + [0.1, -0.1, 0.05]
    both = np.concatenate((lower.rest_position, upper))
    names = ("id", "mass", "rest_length", "stiffness_scale", "damping_scale", "friction_scale", "surface", "region",
             "bend_scale", "arc")  # fmt: skip
    body = dataclasses.replace(
        lower, kind="mixed", rest_position=both, springs=np.concatenate((lower.springs, lower.springs + count)),
        bends=np.concatenate((lower.bends, lower.bends + count)),
        **{n: np.concatenate((getattr(lower, n),) * 2) for n in names},
    )  # fmt: skip
    physics = Physics(stiffness=40.0, damping=0.1, bending_stiffness=1e-4)
    least = {}
    for collide in (False, True):
        sim = SpringMass(body, physics, self_collision=collide)
        ends = lower.rest_position[[0, -1]]
        state = sim.start(holding(state_of(both), {0: 0, count - 1: 1}), still(ends))
        x = sim.rollout(state, still(ends, 40))
        gap = (x[:, :count, None] - x[:, None, count:]).norm(dim=-1)
        least[collide] = float(gap.amin((1, 2)).min())
    assert least[False] < radius  # it passes through
    # The upper strand arrives at 1 m/s; its springs press contacts in until the impulses outweigh them.
    assert least[True] > 0.7 * 2 * radius
    assert float(x[-1, count + 10, 2]) > float(x[-1, 10, 2])  # and it stays on top

"""The kernel against its float64 twin, with everything switched on.

Tolerance: float32 keeps a strain to 1e-7, an error of k 1e-7 / m = 1e-3 m/s^2 here; over the 0.04 s simulated
that is 1e-6 m and 4e-5 m/s. Ten times that is allowed in position, because errors grow along stiff springs;
a velocity that contact sets is such a distance over a substep of 0.5 ms: 2e-3 m/s for 1e-6 m.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from springmass_cases import blob, holding, line, state_of

from pred_core.effects import LIBRARY
from pred_core.effects.algebra import Vec3, exp, sin, sqrt, where
from pred_core.effects.effect import (
    ContactContext,
    Effect,
    GripContext,
    Parameter,
    ParticleContext,
    SpringContext,
)
from pred_core.frames import quaternion_from_rotation_vector
from pred_core.springmass import SpringMass
from pred_core.springmass.reference import Reference
from pred_core.types import Body, Box, Capsule, Grip, Physics, Scene, Sphere

POSITION, VELOCITY = 1e-5, 5e-3


class Everything(Effect):
    """A law in every hook that runs in the substeps, using every function of the algebra."""

    id = "test_everything"
    family = "test"
    hooks = ("force", "spring", "contact", "boundary")
    parameters = (Parameter("a", "1", 0.0, 1.0), Parameter("b", "1", -1.0, 1.0, size=2))

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        swing = sin(3.0 * at.time + at.arc) * p["a"][0]
        return Vec3(at.mass * swing, -(p["b"][0] * at.mass) * at.velocity.norm(), exp(-at.position.x) * at.mass)

    @classmethod
    def spring(cls, p: Mapping[str, Any], at: SpringContext) -> Any:
        strain = at.length / at.rest_length - 1.0
        return where(strain > 0.0, p["a"][0] * at.stiffness * strain * strain, 0.0) + p["b"][1] * at.arc * at.damping

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        return p["a"][0] * at.friction, 0.01 * p["b"][0] * sqrt(1.0 + at.position.x * at.position.x)

    @classmethod
    def boundary(cls, p: Mapping[str, Any], at: GripContext) -> Vec3:
        return (at.axes[0] * 0.01 - at.velocity * 0.02 + at.lever * 0.1) * p["a"][0]


def moved(origin: np.ndarray, periods: int, rng: np.random.Generator) -> Grip:
    """Grippers that travel and turn differently in each of (W, G) worlds; leading axis periods."""
    worlds, grippers = origin.shape[:2]
    way = torch.tensor(rng.normal(size=(worlds, grippers, 3)) * 0.004, dtype=torch.float32)
    turn = torch.tensor(rng.normal(size=(worlds, grippers, 3)) * 0.1, dtype=torch.float32)
    steps = torch.arange(1, periods + 1, dtype=torch.float32)[:, None, None, None]
    closed = torch.ones(periods, worlds, grippers, dtype=torch.bool)
    place = torch.tensor(origin, dtype=torch.float32) + steps * way
    return Grip(place, quaternion_from_rotation_vector(steps * turn), closed)


def at_rest(grips: Grip, origin: np.ndarray) -> Grip:
    rotation = torch.zeros_like(grips.rotation[0])
    rotation[..., 0] = 1.0
    return Grip(torch.tensor(origin, dtype=torch.float32), rotation, grips.closed[0].clone())


def compare(sim: SpringMass, twin: Reference, state: Any, first: Grip, grips: Grip) -> float:
    """Assert agreement; returns how far the object moved [m]."""
    begun = sim.start(state, first)
    positions, after = sim.rollout_states(begun, grips)
    expected, velocity = twin.rollout(begun, grips)
    assert float((positions - expected).abs().max()) < POSITION
    assert float((after.velocity - velocity).abs().max()) < VELOCITY
    return float((positions[-1] - state.position).abs().max())


@pytest.mark.parametrize(("worlds", "staged"), [(3, False), (5, False), (3, True)])
def test_random_objects_with_every_feature_equal_the_reference(
    worlds: int, staged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(LIBRARY, Everything.id, Everything)
    rng = np.random.default_rng(7)
    body = blob(rng)
    assert len(body.bends) > 3
    periods = 4
    physics = [Physics(stiffness=k, damping=d, ground_friction=f, bending_stiffness=e)
               for k, d, f, e in ((60.0, 0.2, 0.3, 2e-4), (100.0, 0.05, 0.9, 0.0), (80.0, 0.5, 0.0, 1e-4),
                                  (70.0, 0.1, 0.5, 1e-4), (90.0, 0.3, 0.2, 0.0))][:worlds]  # fmt: skip
    tilted = (0.96, 0.28, 0.0, 0.0)
    scene = Scene(
        gravity=(1.0, -0.5, -9.0), ground=-0.075, pusher_radius=0.03, grasp_radius=0.03,
        fixtures=(Sphere((0.1, 0.0, -0.1), 0.05), Capsule((-0.1, -0.1, -0.1), (-0.1, 0.1, -0.05), 0.03),
                  Box((0.0, 0.1, 0.0), (0.2, 0.02, 0.05), tilted)),
    )  # fmt: skip
    extension = [(Everything.extension(a=a, b=(0.5 * a, -a)),) for a in (0.2, 0.6, 1.0, 0.4, 0.8)[:worlds]]
    mask = torch.tensor(rng.integers(0, 4, (worlds, len(body.springs))) > 0, dtype=torch.float32)
    options: dict[str, Any] = dict(extensions=extension, spring_mask=mask, self_collision=True, substeps=20)
    start = np.broadcast_to(body.rest_position, (worlds, body.count, 3)) + rng.normal(size=(worlds, 40, 3)) * 0.004
    state = state_of(start, rng.normal(size=(worlds, 40, 3)) * 0.3)
    state = holding(state, {0: 0, 1: 1, 7: 1})
    state.held[1, 7], state.held[2, 2] = 0, 0
    origin = np.stack((start[:, 0], start[:, 1] + 0.01, np.zeros((worlds, 3))), axis=1)
    grips = moved(origin, periods, rng)
    grips.closed[:, :, 2] = False  # pushes,
    grips.closed[2:, 0, 2] = True  # then takes what is near, in one world
    grips.closed[3:, 1, 1] = False  # and another lets go
    first = at_rest(grips, origin)
    sim = SpringMass(body, physics, scene, staged=staged, **options)
    twin = Reference(body, physics, scene, period=sim.period, **options)
    assert compare(sim, twin, state, first, grips) > 1e-3


BENDERS = [
    ("bending_damping", {"time": 0.004}),
    ("bending_hysteresis", {"ratio": 2.0, "reach": 0.1}),
    ("rest_curvature", {"first": (0.3, -0.2, 0.1, 0, 0, 0, 0, 0), "second": (-0.1, 0.2, 0, 0, 0, 0, 0, 0)}),
]


@pytest.mark.parametrize("ends", ["both", "first", "last", "neither", "mixed"])
def test_material_frame_equals_the_reference(ends: str) -> None:
    rng = np.random.default_rng(3)
    body: Body = dataclasses.replace(line(), bend_scale=rng.uniform(0.5, 2.0, 10))
    physics = [Physics(stiffness=60.0, damping=0.3, bending_stiffness=e) for e in (2e-4, 4e-4, 1e-4, 2e-4)]
    extension = [LIBRARY[name].extension(**values) for name, values in BENDERS]
    start = np.stack([body.rest_position + rng.normal(size=(12, 3)) * 0.006 for _ in physics])
    state = state_of(start, rng.normal(size=start.shape) * 0.2)
    taken = {"both": {0: 0, 1: 0, 10: 1, 11: 1}, "first": {0: 0, 1: 0}, "last": {11: 1, 10: 1}}.get(ends, {})
    state = holding(state, taken)
    if ends == "mixed":
        state.held[0, 0], state.held[1, 11], state.held[3, 0], state.held[3, 11] = 0, 1, 0, 1
    origin = start[:, [0, -1]]
    grips = moved(origin, 4, rng)
    sim = SpringMass(body, physics, extensions=extension)
    twin = Reference(body, physics, period=sim.period, substeps=sim.substeps, extensions=extension)
    assert compare(sim, twin, state, at_rest(grips, origin), grips) > 1e-3


def test_two_lines_in_one_body_each_have_their_own_frame() -> None:
    rng = np.random.default_rng(5)
    single = line()
    double = dataclasses.replace(
        single,
        kind="mixed",
        **{name: np.concatenate((getattr(single, name),) * 2)
           for name in ("id", "mass", "rest_length", "stiffness_scale", "damping_scale", "friction_scale", "surface",
                        "region", "bend_scale", "arc")},
        rest_position=np.concatenate((single.rest_position, single.rest_position + [0.0, 1.0, 0.0])),
        springs=np.concatenate((single.springs, single.springs + 12)),
        bends=np.concatenate((single.bends, single.bends + 12)),
    )  # fmt: skip
    physics = Physics(stiffness=60.0, damping=0.3, bending_stiffness=2e-4)
    extension = [LIBRARY[name].extension(**values) for name, values in BENDERS]
    start = single.rest_position + rng.normal(size=(2, 12, 3)) * 0.006
    origin = start[:, [0, -1]]
    grips = moved(origin, 4, rng)
    alone = SpringMass(single, physics, extensions=extension)
    apart = alone.rollout(alone.start(holding(state_of(start), {0: 0, 11: 1}), at_rest(grips, origin)), grips)
    both = SpringMass(double, physics, extensions=extension)
    state = holding(state_of(start.reshape(24, 3)), {0: 0, 11: 1, 12: 2, 23: 3})
    four = Grip(grips.position.flatten(1, 2), grips.rotation.flatten(1, 2), grips.closed.flatten(1, 2))
    together = both.rollout(both.start(state, at_rest(Grip(four.position, four.rotation, four.closed),
                                                      origin.reshape(4, 3))), four)  # fmt: skip
    # The same operations in the same order; only the width of a register differs.
    assert float((together.reshape(4, 2, 12, 3) - apart).abs().max()) < 1e-6

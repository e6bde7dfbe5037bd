"""Many worlds, lanes, schedules and calls give one result; bad input gives a clear error."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from springmass_cases import NOWHERE, blob, holding, line, nobody, state_of, still

from pred_core.effects import LIBRARY
from pred_core.errors import ConfigError, DivergenceError, InputError, TwinError
from pred_core.springmass import SpringMass
from pred_core.types import Grip, Physics, Scene, State

SCENE = Scene(ground=-0.02)
BASE = Physics(stiffness=60.0, damping=0.1, ground_friction=0.4, bending_stiffness=2e-4)


def batch(worlds: int) -> tuple[State, Grip, Grip]:
    """A line held at one end, flung differently in each world, its gripper going its own way for 12 periods."""
    rng = np.random.default_rng(worlds)
    body = line()
    state = holding(state_of(np.stack([body.rest_position] * worlds), rng.normal(size=(worlds, 12, 3)) * 0.3), {0: 0})
    first = still(torch.zeros(worlds, 1, 3))
    way = torch.linspace(0.1, 1, 12)[:, None, None, None] * torch.tensor(rng.normal(size=(worlds, 1, 3)) * 0.05)
    grips = still(torch.zeros(worlds, 1, 3), 12)
    return state, first, Grip(way.float(), grips.rotation, grips.closed)


def world(state: State, w: int) -> State:
    return State(state.position[w], state.velocity[w], state.held[w])


@pytest.mark.parametrize("worlds", [1, 5, 16, 37])
def test_batch_equals_loop_bit_for_bit(worlds: int) -> None:
    physics = [dataclasses.replace(BASE, stiffness=40.0 + w, ground_friction=0.1 * w) for w in range(worlds)]
    state, first, grips = batch(worlds)
    sim = SpringMass(line(), physics, SCENE, substeps=20)
    together = sim.rollout(sim.start(state, first), grips)
    for w in range(0, worlds, 6):
        alone = SpringMass(line(), physics[w], SCENE, substeps=20)
        begun = alone.start(world(state, w), Grip(first.position[w], first.rotation[w], first.closed[w]))
        x = alone.rollout(begun, Grip(grips.position[:, w], grips.rotation[:, w], grips.closed[:, w]))
        assert torch.equal(x, together[:, w])


def test_leading_axes_are_any() -> None:
    state, first, grips = batch(6)
    sim = SpringMass(line(), BASE, SCENE)
    flat = sim.rollout(sim.start(state, first), grips)
    shaped = State(*(v.unflatten(0, (2, 3)) for v in (state.position, state.velocity, state.held)))
    begun = sim.start(shaped, Grip(*(v.unflatten(0, (2, 3)) for v in vars(first).values())))
    x, last = sim.rollout_states(begun, Grip(*(v.unflatten(1, (2, 3)) for v in vars(grips).values())))
    assert torch.equal(x.flatten(1, 2), flat)
    assert last.position.shape == (2, 3, 12, 3)


@pytest.mark.parametrize("worlds", [1, 5])
def test_step_equals_rollout_and_staged_equals_fused_bit_for_bit(worlds: int) -> None:
    state, first, grips = batch(worlds)
    sim = SpringMass(line(), BASE, SCENE)
    begun = sim.start(state, first)
    x, last = sim.rollout_states(begun, grips)
    now = begun
    for t in range(12):
        now = sim.step(now, grips.at(t))
        assert torch.equal(now.position, x[t])
    assert torch.equal(now.velocity, last.velocity)
    staged = SpringMass(line(), BASE, SCENE, staged=True)
    assert torch.equal(staged.rollout(staged.start(state, first), grips), x)


def test_step_returns_a_new_state_and_calls_do_not_disturb_each_other() -> None:
    state, first, grips = batch(16)
    sim = SpringMass(line(), BASE, SCENE)
    begun = sim.start(state, first)
    kept = begun.position.clone()
    one = sim.step(begun, grips.at(0))
    copy = one.position.clone()
    two = sim.step(one, grips.at(1))
    assert torch.equal(begun.position, kept) and torch.equal(one.position, copy)
    again = sim.step(sim.step(begun, grips.at(0)), grips.at(1))
    assert torch.equal(again.position, two.position)


def test_spring_mask_removes_springs() -> None:
    body = blob(np.random.default_rng(0))
    keep = torch.ones(2, len(body.springs))
    keep[1, ::2] = 0.0
    sim = SpringMass(body, BASE, spring_mask=keep, substeps=20)
    state = state_of(np.stack([body.rest_position] * 2), 0.1 * np.random.default_rng(1).normal(size=(2, 40, 3)))
    x = sim.rollout(sim.start(state), nobody(5))
    chosen = np.arange(len(body.springs)) % 2 == 1
    names = ("springs", "rest_length", "stiffness_scale", "damping_scale")
    fewer = dataclasses.replace(body, **{n: getattr(body, n)[chosen] for n in names})
    alone = SpringMass(fewer, BASE, substeps=20)
    y = alone.rollout(alone.start(world(state, 1)), nobody(5))
    assert float((x[:, 1] - y).abs().max()) < 1e-6  # other sums of the same forces


def test_divergence_is_an_error_or_nan() -> None:
    body = line()
    stiff = Physics(stiffness=1e5, damping=0.01)
    state = state_of(body.rest_position, np.random.default_rng(0).normal(size=(12, 3)))
    sim = SpringMass(body, stiff, substeps=1)
    with pytest.raises(DivergenceError, match="substeps"):
        sim.rollout(sim.start(state), nobody(200))
    quiet = SpringMass(body, stiff, substeps=1, diverged_as_nan=True)
    assert not torch.isfinite(quiet.rollout(quiet.start(state), nobody(200))[-1]).all()
    # One diverged world leaves its neighbours and the next call alone.
    pair = SpringMass(body, [BASE, stiff], substeps=20, diverged_as_nan=True)
    two = State(*(torch.stack((v, v)) for v in (state.position, state.velocity, state.held)))
    x = pair.rollout(pair.start(two), nobody(200))
    alone = SpringMass(body, BASE, substeps=20)
    expected = alone.rollout(alone.start(state), nobody(200))
    assert torch.equal(x[:, 0], expected) and not torch.isfinite(x[-1, 1]).all()
    assert torch.equal(pair.rollout(pair.start(two), nobody(200))[:, 0], expected)


def test_bad_input_is_named() -> None:
    body = line()
    sim = SpringMass(body, BASE)
    state = holding(state_of(body.rest_position), {0: 0})
    grip = still(torch.zeros(1, 3))
    good = sim.start(state, grip)
    nan = state.position.clone()
    nan[3, 1] = float("nan")
    turned = grip.rotation.clone() * 1.1
    cases = [
        (lambda: sim.start(state), "no gripper pose"),
        (lambda: sim.start(state.replace(position=state.position[:5]), grip), "position"),
        (lambda: sim.start(state.replace(position=nan), grip), "not finite: particle 3"),
        (lambda: sim.step(good.replace(velocity=nan), grip), "not finite: particle 3"),
        (lambda: sim.start(state.replace(held=state.held.float()), grip), "integer"),
        (lambda: sim.start(state.replace(position=state.position.int()), grip), "floats"),
        (lambda: sim.start(state.replace(held=state.held + 3), grip), "held gripper index"),
        (lambda: sim.step(state, grip), "never started"),
        (lambda: sim.step(good, still(torch.zeros(2, 3))), "grippers"),
        (lambda: sim.step(good, Grip(grip.position * float("nan"), grip.rotation, grip.closed)), "not finite"),
        (lambda: sim.step(good, Grip(grip.position, turned, grip.closed)), "unit quaternion"),
        (lambda: sim.step(good, Grip(grip.position, grip.rotation[:, :3], grip.closed)), "shapes"),
        (lambda: sim.rollout(good, grip), "rollout"),
        (lambda: sim.rollout(good, still(torch.zeros(1, 3), 4).span(0, 0)), "rollout"),
    ]
    for call, words in cases:
        with pytest.raises(InputError, match=words):
            call()
    two = SpringMass(body, [BASE, BASE])
    with pytest.raises(InputError, match="one for each Physics"):
        two.step(two.start(state, grip), grip)
    drag = LIBRARY["drag_linear"]
    with pytest.raises(TwinError, match="coefficient"):
        SpringMass(body, BASE, extensions=[drag.extension(coefficient=-1.0)])
    with pytest.raises(ConfigError, match="same effects"):
        SpringMass(body, [BASE, BASE], extensions=[(drag.extension(coefficient=1.0),), ()])
    with pytest.raises(ConfigError, match="too stiff"):
        SpringMass(line(mass=1e-9), Physics(stiffness=1e5))


def test_buffers_of_long_rollouts_are_not_hoarded() -> None:
    body = line()
    sim = SpringMass(body, Physics(stiffness=0.1, damping=1e-6), NOWHERE, substeps=1)
    state = sim.start(state_of(np.stack([body.rest_position] * 64)))
    for periods in range(900, 912):  # 8 MB each, more sizes than are kept
        sim.rollout(state, nobody(periods))
    assert sum(work.bytes for work, _, _ in sim._workspaces.values()) <= 1 << 28
    assert len(sim._workspaces) <= 8


@pytest.mark.parametrize(("name", "said"), [
    ("cuda", "device; got cuda; allowed: cpu. Without a CUDA device"), ("gpu", "device; got gpu"),
])  # fmt: skip
def test_a_device_that_is_not_here_is_refused(name: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever simulates goes through here: plan, train, the planner node."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=said):
        SpringMass(line(), BASE, SCENE, device=name)

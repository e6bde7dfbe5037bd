"""Laws of mechanics that the simulator must obey."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from springmass_cases import NOWHERE, blob, holding, line, nobody, particles, state_of, still, zigzag
from torch import Tensor

from pred_core.effects import LIBRARY
from pred_core.errors import ConfigError, DivergenceError
from pred_core.frames import rotation_about_z
from pred_core.springmass import SpringMass
from pred_core.springmass.parameters import added_by
from pred_core.springmass.stability import spectrum_bound
from pred_core.springmass.topology import bend_lengths
from pred_core.types import Array, Body, Grip, Physics, Scene, State

G = 9.81


def run(sim: SpringMass, state: State, periods: int) -> tuple[Tensor, State]:
    return sim.rollout_states(sim.start(state), nobody(periods))


def energy(body: Body, physics: Physics, state: State) -> float:
    """Kinetic, elastic, bending and potential energy [J]."""
    x, v, m = state.position.double(), state.velocity.double(), torch.as_tensor(body.mass)
    i, j = torch.as_tensor(body.springs, dtype=torch.long).T
    rest = torch.as_tensor(body.rest_length)
    stretch = (x[j] - x[i]).norm(dim=-1) - rest
    k = physics.stiffness * torch.as_tensor(body.stiffness_scale) / rest
    total = 0.5 * (m * v.square().sum(-1)).sum() + 0.5 * (k * stretch.square()).sum()
    if len(body.bends):
        a, b, c = (x[torch.as_tensor(body.bends[:, n], dtype=torch.long)] for n in range(3))
        cosine = torch.cosine_similarity(b - a, c - b, dim=-1)
        ei = physics.bending_stiffness * torch.as_tensor(body.bend_scale / bend_lengths(body))
        total = total + (2.0 * ei * (1 - cosine) / (1 + cosine)).sum()
    return float(total)


def test_free_fall_is_the_discrete_sum() -> None:
    # Semi-implicit Euler after n substeps: v = g n h, z = g h^2 n (n + 1) / 2.
    body = particles(np.zeros((2, 3)) + [[0, 0, 0], [1, 0, 0]])
    sim = SpringMass(body, Physics(), substeps=10)
    x, after = run(sim, state_of(body.rest_position), 20)
    n, h = 200, 0.001  # 200 roundings of 6e-8 at most
    assert float(x[-1, 0, 2]) == pytest.approx(-G * h * h * n * (n + 1) / 2, rel=1.2e-5)
    assert float(after.velocity[0, 2]) == pytest.approx(-G * n * h, rel=1.2e-5)


def test_pendulum_period() -> None:
    # T = 2 pi sqrt(L/g) (1 + a^2/16) = 2.00641 s for L = 1 m, a = 0.1 rad.
    body = particles(np.array([[0.0, 0, 0], [0, 0, -1.0]]))
    body = dataclasses.replace(body, springs=np.array([[0, 1]], np.int32), rest_length=np.ones(1),
                               stiffness_scale=np.ones(1), damping_scale=np.ones(1))  # fmt: skip
    sim = SpringMass(body, Physics(stiffness=3000.0, damping=1.0))
    swung = state_of(np.array([[0.0, 0, 0], [math.sin(0.1), 0, -math.cos(0.1)]]))
    grips = still(torch.zeros(1, 3), 420)
    x = sim.rollout(sim.start(holding(swung, {0: 0}), still(torch.zeros(1, 3))), grips)[:, 1, 0].numpy()
    down = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    at = [0.01 * (n + x[n] / (x[n] - x[n + 1])) for n in down]
    # The weight stretches the spring by m g / k = 0.03 %; linear interpolation of the crossing is finer.
    assert at[1] - at[0] == pytest.approx(2 * math.pi * math.sqrt(1 / G) * (1 + 0.01 / 16), rel=1e-3)


def test_momentum_is_kept_without_gravity() -> None:
    rng = np.random.default_rng(0)
    body = blob(rng)
    assert len(body.bends)
    sim = SpringMass(body, Physics(stiffness=60.0, damping=0.2, bending_stiffness=1e-3), NOWHERE)
    state = state_of(body.rest_position, rng.normal(size=(40, 3)) * 0.5)
    _, after = run(sim, state, 30)
    m = torch.as_tensor(body.mass)[:, None]
    for quantity in (
        lambda s: (m * s.velocity.double()).sum(0),
        lambda s: (m * torch.linalg.cross(s.position.double(), s.velocity.double())).sum(0),
    ):
        # 30 x substeps roundings of 1e-7 each that add like a random walk, far below 1e-5 of the first value.
        assert float((quantity(after) - quantity(state)).norm() / quantity(state).norm()) < 1e-5


@pytest.mark.parametrize("kind", ["blob", "line"])
def test_energy_never_grows(kind: str) -> None:
    rng = np.random.default_rng(1)
    body = blob(rng) if kind == "blob" else line(mass=0.2)
    physics = Physics(stiffness=60.0, damping=0.05, bending_stiffness=0.0 if kind == "blob" else 5e-3)
    levels = energies(body, physics, body.rest_position, rng.normal(size=(body.count, 3)) * 0.5, periods=60)
    # A symplectic step keeps a shadow energy that differs by a quarter of (h w)^2, which is 1 at half the stability
    # limit, in the fastest modes; the line's damping is too small to hide that.
    assert max(np.diff(levels)) < 0.25 * levels[0] and levels.max() < 1.25 * levels[0]
    assert levels[-1] < 0.9 * levels[0]


def energies(
    body: Body, physics: Physics, x: Array, v: Array | float, periods: int, substeps: int | None = None
) -> Array:
    """Energies [J] before and after each period, with the substeps that are chosen if none are given."""
    sim = SpringMass(body, physics, NOWHERE, substeps=substeps, diverged_as_nan=True)
    state = sim.start(state_of(x, v))
    levels = [energy(body, physics, state)]
    for _ in range(periods):
        state = sim.step(state, nobody())
        levels.append(energy(body, physics, state))
    return np.array(levels)


# Springs that yield to their bends by 24, 8 and 2 %; nothing is lost but by rounding.
@pytest.mark.parametrize(("stiffness", "degrees"), [(20.0, 90), (60.0, 90), (60.0, 45), (300.0, 90)])
def test_sharp_bends_are_stable_at_the_chosen_substeps(stiffness: float, degrees: float) -> None:
    body = line(13, 0.6, mass=0.06)
    physics = Physics(stiffness=stiffness, damping=0.0, bending_stiffness=3e-3)
    bent = zigzag(13, 0.05, degrees) + np.random.default_rng(0).normal(size=(13, 3)) * 1e-3
    levels = energies(body, physics, bent, 0.0, periods=100)
    # 11 bends of 2 EI/lbar tan^2(angle/2) and what the springs' noise holds, 1e-3 m: k/l0 x^2 over 12 springs.
    assert levels[0] == pytest.approx(11 * 2 * 0.06 * math.tan(math.radians(degrees) / 2) ** 2, rel=0.5)
    # The shadow energy's share is a quarter of (h w)^2 = 1 at most in the fastest modes; blowing up is a factor 1e3.
    assert levels.max() < 1.3 * levels[0]
    chosen = SpringMass(body, physics, NOWHERE).substeps
    if degrees == 90:  # and they are not wasted
        coarse = energies(body, physics, bent, 0.0, periods=100, substeps=chosen // 3)
        assert not coarse.max() < 10 * levels[0]


def test_contact_adds_no_energy() -> None:
    body = line(mass=0.2, radius=0.004)
    physics = Physics(stiffness=60.0, damping=0.05, bending_stiffness=5e-3, ground_friction=0.4)
    sim = SpringMass(body, physics, Scene(ground=0.0))
    dropped = body.rest_position @ rotation_about_z(torch.tensor(0.3)).double().numpy().T + [0, 0, 0.1]
    dropped[:, 2] += 0.02 * np.sin(np.arange(12))
    state = sim.start(state_of(dropped))
    levels = []
    for _ in range(100):
        height = float((torch.as_tensor(body.mass) * state.position[:, 2]).sum())
        levels.append(energy(body, physics, state) + G * height)
        state = sim.step(state, nobody())
    assert max(np.diff(levels)) < 0.01 * levels[0]
    assert float(state.velocity.norm(dim=-1).max()) < 0.05  # and the line has come to rest
    assert float(state.position[:, 2].min()) >= 0.004 - 1e-6


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_sliding_on_an_incline_stops_above_the_friction_angle(ratio: float) -> None:
    angle, mu = 0.5, ratio * math.tan(0.5)
    gravity = (G * math.sin(angle), 0.0, -G * math.cos(angle))
    body = particles(np.array([[0.0, 0, 0], [0.0, 1, 0]]))
    sim = SpringMass(body, Physics(ground_friction=mu), Scene(gravity=gravity, ground=0.0))
    x, after = run(sim, state_of(body.rest_position, np.array([0.1, 0, 0])), 60)
    pull = gravity[0] - mu * G * math.cos(angle)  # -+0.470 m/s^2
    if ratio > 1:  # stops after v0 / 0.470 = 0.213 s, v0^2 / (2 0.470) = 1.06 cm down
        assert float(after.velocity.abs().max()) < 1e-6
        assert float(x[-1, 0, 0]) == pytest.approx(0.01 / (2 * -pull), rel=0.05)
    else:
        assert float(after.velocity[0, 0]) == pytest.approx(0.1 + pull * 0.6, rel=1e-3)


def test_hanging_chain_is_a_catenary() -> None:
    count, span, length = 41, 1.0, 1.3
    a = brentq(lambda a: 2 * a * math.sinh(span / (2 * a)) - length, 0.1, 10)
    s = np.linspace(-length / 2, length / 2, count)
    curve = np.stack((a * np.arcsinh(s / a), 0 * s, np.sqrt(a * a + s * s)), axis=1)
    body = line(count, length, mass=0.1, connection_threshold=1.5 * length / 40)
    drag = LIBRARY["drag_linear"].extension(coefficient=5.0)
    sim = SpringMass(body, Physics(stiffness=300.0, damping=0.2), extensions=[drag])
    begin = curve.copy()
    begin[1:-1, 2] += 0.1 * np.sin(np.arange(39))  # far from it
    ends = curve[[0, -1]]
    state = sim.start(holding(state_of(begin), {0: 0, 40: 1}), still(ends))
    x = sim.rollout(state, still(ends, 400))[-1].numpy()
    # Stretch: at most the end's tension / stiffness = 0.9 N / 300 N; 40 pieces: 1e-3 of the sag. Together 0.5 % of L.
    assert np.abs(x - curve).max() < 0.005 * length


def test_cantilever_deflects_as_euler_bernoulli_says() -> None:
    # Point loads m g at s: sum m g s^2 (3 L - s) / (6 EI); a tip load alone gives F L^3 / (3 EI).
    count, ei = 21, 0.4
    body = line(count, 0.525, mass=0.02, connection_threshold=0.04)
    mass = body.mass.copy()
    mass[-1] = 0.02
    body = dataclasses.replace(body, mass=mass)
    # The held edge 0-1 is the clamp. The bend at particle 1 stands for half an edge either side: it begins mid-edge.
    s = body.rest_position[1:, 0] - body.rest_position[:2, 0].mean()
    expected = float((mass[1:] * G * s**2 * (3 * s[-1] - s)).sum() / (6 * ei))
    damping = LIBRARY["drag_linear"].extension(coefficient=8.0)
    sim = SpringMass(body, Physics(stiffness=100.0, damping=0.05, bending_stiffness=ei), extensions=[damping])
    ends = body.rest_position[:1]
    state = sim.start(holding(state_of(body.rest_position), {0: 0, 1: 0}), still(ends))
    x = sim.rollout(state, still(ends, 300))[-1]
    # Small-deflection theory: 5 % of L deflects, of which (5 %)^2 and 1/20^2 are neglected.
    assert 0.01 * s[-1] < expected < 0.15 * s[-1]
    assert -float(x[-1, 2]) == pytest.approx(expected, rel=0.01)


def test_turning_everything_about_gravity_turns_the_result() -> None:
    rng = np.random.default_rng(2)
    body = blob(rng)
    sim = SpringMass(body, Physics(stiffness=60.0, damping=0.2, bending_stiffness=1e-3), Scene(ground=-0.12))
    turn = rotation_about_z(torch.tensor(1.1, dtype=torch.float64)).numpy()
    v = rng.normal(size=(40, 3)) * 0.3
    first = torch.tensor(body.rest_position[:1], dtype=torch.float32)
    ways = []
    for rotate in (np.eye(3), turn):
        r = torch.tensor(rotate, dtype=torch.float32)
        state = holding(state_of(body.rest_position @ rotate.T, v @ rotate.T), {0: 0})
        way = torch.linspace(0, 0.1, 20)[:, None, None] * torch.tensor([1.0, 0.5, 0.2])
        grips = still(first @ r.T, 20)
        grips = Grip(grips.position + way @ r.T, grips.rotation, grips.closed)
        ways.append(sim.rollout(sim.start(state, still(first @ r.T)), grips) @ r)
    assert float((ways[0] - ways[1]).abs().max()) < 2e-5  # float32 roundings of another set of numbers


# Bends alone are bounded at 90 degrees with edges pressed to half. Rows there sum to 2 (1 + 2^.5/2) (2 + 2^.5) = 11.7
# instead of 16 and count twice: a straight line could do with 1 in 2 (2 11.7/16)^.5 / 0.5 = 4.8.
@pytest.mark.parametrize(("stiffness", "damping", "bending", "fewer"), [
    (1e5, 1e-6, 0.0, 3), (0.1, 100.0, 0.0, 3), (1e5, 100.0, 0.0, 3), (0.1, 1e-6, 10.0, 6)])  # fmt: skip
def test_chosen_substeps_are_stable_and_not_wasteful(
    stiffness: float, damping: float, bending: float, fewer: int
) -> None:
    body = line(8, 0.7, mass=8.0)
    physics = Physics(stiffness=stiffness, damping=damping, bending_stiffness=bending)
    rng = np.random.default_rng(4)
    state = state_of(body.rest_position, rng.normal(size=(8, 3)) * 0.01)
    sim = SpringMass(body, physics, NOWHERE, diverged_as_nan=True)
    _, after = run(sim, state, 30)
    assert float(after.velocity.abs().max()) < 0.1  # no more than it began with
    coarse = SpringMass(body, physics, NOWHERE, substeps=max(sim.substeps // fewer, 1), diverged_as_nan=True)
    _, after = run(coarse, state, 30)
    assert not float(after.velocity.abs().max()) < 1.0


def test_effects_compose_as_they_do_in_the_kernel() -> None:
    # EI (1 + 3) (1 + 2): profile p = 2 makes (1 + p/2)^2 = 4; hysteresis a = 2 works on that; damping 0.1 s x 4.
    made = [
        LIBRARY["bending_profile"].extension(relative=(2.0,) * 12),
        LIBRARY["bending_hysteresis"].extension(ratio=2.0),
        LIBRARY["bending_damping"].extension(time=0.1),
        LIBRARY["drag_linear"].extension(coefficient=3.0),
        LIBRARY["drag_quadratic"].extension(coefficient=2.0),  # at 5 m/s
    ]
    added = added_by(line(), made)
    assert (added.stiffness, added.time, added.rate) == pytest.approx((2.0, 0.1, 13.0))
    assert added.scale == pytest.approx(np.full(10, 4.0))
    # Bends alone: w^2 grows by (1 + 3) (1 + 2) = 12 and d is four times the row sum times 0.1 s.
    soft = Physics(stiffness=1e-9, damping=0.0, bending_stiffness=1e-3)
    w, _ = spectrum_bound(line(), soft)
    assert spectrum_bound(line(), soft, added) == pytest.approx((w * math.sqrt(12.0), 0.4 * w * w + 13.0))
    # A set of k0 = 2: the worst bend up to 90 degrees grows from 8 to 12 and the edges' turning from 4 to 8.
    assert added_by(line(), [LIBRARY["rest_curvature"].extension(first=(2.0,) * 12)]).stiffness == pytest.approx(1.0)


def test_bends_are_bounded_with_the_rest_lengths_of_their_springs() -> None:
    # The same springs and bends, rest positions drawn twice as long: the kernel reads rest lengths only.
    body = line()
    longer = dataclasses.replace(body, rest_position=2.0 * body.rest_position)
    physics = Physics(stiffness=60.0, damping=0.05, bending_stiffness=5e-3)
    assert spectrum_bound(longer, physics) == pytest.approx(spectrum_bound(body, physics))


def test_substeps_below_one_are_refused() -> None:
    with pytest.raises(ConfigError, match="substeps"):
        SpringMass(line(), Physics(), substeps=0)


def test_finite_but_absurd_positions_are_a_divergence() -> None:
    # 9.81 / 2 t^2 = 100 m after 4.5 s: in free fall the 452nd period of 10 ms is the first beyond.
    body = particles(np.array([[0.0, 0, 0], [1, 0, 0]]))
    fall = state_of(body.rest_position)
    sim = SpringMass(body, Physics(), substeps=10)
    with pytest.raises(DivergenceError, match="100 m from the origin at step 452 "):
        sim.rollout(sim.start(fall), nobody(500))
    marked = SpringMass(body, Physics(), substeps=10, diverged_as_nan=True)
    x, after = marked.rollout_states(marked.start(fall), nobody(500))
    assert torch.isfinite(x[:451]).all() and torch.isnan(x[451:]).all() and torch.isnan(after.position).all()
    near = marked.start(state_of(body.rest_position - [0.0, 0.0, 99.999], torch.tensor([0.0, 0.0, -1.0])))
    assert torch.isnan(marked.step(near, nobody()).position).all()


def test_a_particle_inside_the_table_comes_out_without_throwing_its_neighbours() -> None:
    """The middle of a lying rope is measured 3 mm inside the table. It leaves at 0.1 m/s, in 30 ms; damped bends may
    drag the neighbours along, no faster and no farther. Taken for a motion of one substep, the way out threw the rope
    12 mm into the air.
    """
    body = line(radius=0.004)
    scene = Scene(gravity=(0.0, 0.0, -G), ground=0.0)
    physics = Physics(stiffness=60.0, damping=0.05, bending_stiffness=3e-4)
    damped = [LIBRARY["bending_damping"].extension(time=0.2)]
    state = state_of(body.rest_position + [0.0, 0.0, 0.004])
    state.position[6, 2] -= 0.003
    sim = SpringMass(body, physics, scene, extensions=damped, period=0.005)
    x, after = run(sim, state, 20)
    assert x[4:6, 6, 2].numpy() == pytest.approx([0.0035, 0.004], abs=1e-5)
    assert float(x[..., 2].max()) < 0.004 + 0.0015  # half of the way
    assert float(after.velocity.abs().max()) < 0.01


def test_the_way_out_of_a_surface_does_not_depend_on_the_substep() -> None:
    """9 mm inside at 0.1 m/s: 1 mm a period of 10 ms, then it stands."""
    for substeps in (4, 16):
        body = particles(np.array([[0.0, 0.0, -0.009], [1.0, 0.0, 0.0]]))
        sim = SpringMass(body, Physics(), Scene(gravity=(0.0, 0.0, 0.0), ground=0.0), period=0.01, substeps=substeps)
        x, _ = run(sim, state_of(body.rest_position), 12)
        assert x[:, 0, 2].numpy() == pytest.approx(np.minimum(-0.009 + 0.001 * np.arange(1, 13), 0.0), abs=1e-6)

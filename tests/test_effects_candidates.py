"""Causes from around an object: what each law does by hand, and that a planted value is found again."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from springmass_cases import NOWHERE, holding, line, nobody, particles, state_of, still, zigzag
from torch import Tensor

from pred_core.effects import LIBRARY
from pred_core.frames import quaternion_from_rotation_vector
from pred_core.springmass import SpringMass
from pred_core.springmass.arrays import mass_of_worlds
from pred_core.springmass.reference import Reference
from pred_core.twin import Extension
from pred_core.types import Body, Grip, Physics, Scene, State

G = 9.81


def one(id: str, **values: float | tuple[float, ...]) -> list[Extension]:
    return [LIBRARY[id].extension(**values)]


def flown(
    extensions: list[Extension], place: list[list[float]], velocity: list[list[float]], periods: int,
    scene: Scene = NOWHERE, friction: float = 0.0, begin: float = 0.0, substeps: int | None = 20,
) -> tuple[Tensor, State]:  # fmt: skip
    """Loose particles of 0.1 kg: positions (T, N, 3) and the state after periods of 0.01 s."""
    sim = SpringMass(particles(np.array(place)), Physics(ground_friction=friction), scene, extensions=extensions,
                     substeps=substeps)  # fmt: skip
    state = sim.start(state_of(np.array(place), torch.tensor(velocity)))
    return sim.rollout_states(begun(state, begin), nobody(periods))


def begun(state: State, seconds: float) -> State:
    """The state, so many seconds into its session."""
    return state.replace(memory={**state.memory, "time": torch.full_like(state.memory["time"], seconds)})


def stops(extensions: list[Extension], degrees: list[float], friction: float, begin: float = 0.0) -> list[float]:
    """How far [m] particles slide on a table that start at 1 m/s in these directions, 10 m apart."""
    place = [[0.0, 10.0 * n, 0.0] for n in range(len(degrees) + 1)]
    angle = np.radians([*degrees, 0.0])
    velocity = np.stack((np.cos(angle), np.sin(angle), 0 * angle), axis=1).tolist()
    x, _ = flown(extensions, place, velocity, 120, Scene(ground=0.0), friction, begin)
    return (x[-1] - torch.tensor(place)).norm(dim=-1)[:-1].tolist()


def test_wind_carries_what_falls() -> None:
    # Falling steadily, the air passes from below only: v = w sideways and sqrt(g / b) = 2 m/s down.
    _, after = flown(one("wind", coefficient=G / 4, velocity=(3.0, -1.0)), [[0.0] * 3, [1.0, 0.0, 0.0]],
                     [[0.0] * 3] * 2, 600, Scene())  # fmt: skip
    assert after.velocity[0].tolist() == pytest.approx([3.0, -1.0, -2.0], rel=1e-4)


def test_wind_pushes_a_line_across_itself() -> None:
    """A straight line along (cos a, sin a) in a wind of 4 m/s along x, in one step of 0.01 s with b = 0.5 1/m: across
    itself by b (w sin a)^2, along itself not at all. With a share of one it is pushed as loose particles are, by b w^2
    along x. Both with and without bending stiffness, one world and five.
    """
    angle = math.radians(30.0)
    axis, across = np.array([math.cos(angle), math.sin(angle), 0.0]), np.array([math.sin(angle), -math.cos(angle), 0.0])
    body = dataclasses.replace(line(7, 0.6), rest_position=np.linspace(0.0, 0.6, 7)[:, None] * axis)
    wanted = {0.0: 0.01 * 0.5 * (4.0 * math.sin(angle)) ** 2 * across, 1.0: np.array([0.01 * 0.5 * 16.0, 0.0, 0.0])}
    for share, change in wanted.items():
        for stiffness in (0.0, 1e-4):
            for worlds in (1, 5):
                blow = one("wind", coefficient=0.5, velocity=(4.0, 0.0), along=share)
                physics = Physics(stiffness=1.0, bending_stiffness=stiffness)
                sim = SpringMass(body, physics, NOWHERE, extensions=blow, substeps=1)
                state = sim.start(state_of(np.stack([body.rest_position] * worlds)))
                _, after = sim.rollout_states(state, nobody(1))
                assert np.allclose(after.velocity.numpy(), change, atol=1e-6), (share, stiffness, worlds)


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 3.0])
def test_drag_of_any_power_slows_by_its_law(power: float) -> None:
    # v' = -b v^p from 2 m/s for 1 s: v^(1-p) grows by (p - 1) b t; for p = 1 v falls by exp(-b t).
    slow = one("drag_power", coefficient=0.7, power=power)
    _, after = flown(slow, [[0.0] * 3, [5.0, 0.0, 0.0]], [[2.0, 0.0, 0.0]] * 2, 100)
    left = 2.0 * math.exp(-0.7) if power == 1.0 else (2.0 ** (1 - power) + (power - 1) * 0.7) ** (1 / (1 - power))
    assert float(after.velocity[0, 0]) == pytest.approx(left, rel=1e-3)


def test_friction_of_the_square_slows_by_its_law() -> None:
    # v' = -c g v^2 from 1 m/s: after 1.2 s log(1 + 1.2 c g) / (c g).
    c = 0.3
    assert stops(one("friction_power", coefficient=c, power=2.0), [0.0, 90.0], 0.0) == pytest.approx(
        [math.log(1.0 + 1.2 * c * G) / (c * G)] * 2, rel=2e-3
    )


def test_attraction_is_strongest_at_its_range() -> None:
    # In one step of 0.01 s: a at d = r, and 2 exp(1/2 - 2) a = 0.44626 a at d = 2 r.
    push = one("attraction", strength=2.0, center=(0.1, 0.2, 0.3), range=0.2)
    _, after = flown(push, [[-0.1, 0.2, 0.3], [0.1, 0.2, -0.1]], [[0.0] * 3] * 2, 1, substeps=1)
    assert after.velocity[0].tolist() == pytest.approx([0.02, 0.0, 0.0], abs=1e-7)
    assert after.velocity[1].tolist() == pytest.approx([0.0, 0.0, 0.02 * 0.44626], abs=1e-7)


def test_tether_swings_a_quarter_period_and_lets_go() -> None:
    # 10 N/m on 0.1 kg: 10 rad/s. Let go 0.1 m beyond the slack length, it passes that after pi/20 s at 1 m/s and
    # coasts: at 0.2 s it is 0.2 - (0.2 - pi/20) m from the anchor. The other particle is not tied.
    thread = one("tether", stiffness=10.0, arc=1.0, anchor=(0.0, 0.0, 0.0), length=0.2)
    x, after = flown(thread, [[0.0, 0.5, 0.0], [0.0, 0.0, 0.3]], [[0.0] * 3] * 2, 20)
    assert float(after.velocity[1, 2]) == pytest.approx(-1.0, rel=2e-3)
    assert float(x[-1, 1, 2]) == pytest.approx(math.pi / 20, rel=5e-3)
    assert torch.equal(x[-1, 0], torch.tensor([0.0, 0.5, 0.0]))


def test_tether_ties_one_point_whatever_its_place_between_particles() -> None:
    # A line of 30 at rest, pulled for one step by k (d - 0.2 m): all of it goes to the two particles beside s.
    body = line(30, 0.58)
    for s in (0.5, 0.51, 0.52, 1.0):
        sim = SpringMass(body, Physics(), NOWHERE, substeps=1,
                         extensions=one("tether", stiffness=2.0, arc=s, anchor=(0.58 * s, 0.0, 1.2)))  # fmt: skip
        _, after = sim.rollout_states(sim.start(state_of(body.rest_position)), nobody(1))
        pulled = torch.as_tensor(body.mass) * after.velocity[:, 2]
        assert float(pulled.sum()) == pytest.approx(2.0 * 0.01, rel=1e-3)
        assert int((pulled > 1e-9).sum()) <= 2


def test_obstacle_carries_what_lies_on_it_and_does_not_bounce() -> None:
    # At rest g = w^2 depth^2 / 2 skin with w = 200 rad/s and 3 mm of skin: depth = sqrt(0.006 * 9.81 / 4e4) = 1.213 mm.
    ball = one("obstacle", radius=0.1, center=(1.0, 0.0, 0.0))
    x, _ = flown(ball, [[1.0, 0.0, 0.15], [0.0, 0.0, 0.0]], [[0.0] * 3] * 2, 150, Scene())
    assert float(x[-1, 0, 2]) == pytest.approx(0.1 - 1.213e-3, abs=2e-6)
    assert float(x[:, 0, 2].min()) > 0.1 - 0.01  # it came with 1 m/s: v / w = 5 mm without damping and skin
    landed = int((x[:, 0, 2] < 0.1).nonzero()[0])
    assert float(x[landed:, 0, 2].max()) < 0.101
    assert float(x[-1, 1, 2]) < -10.0  # beside the ball nothing holds


def test_obstacle_rubs() -> None:
    # 1 cm deep: p = 200^2 (0.01 - 0.0015) = 340 m/s^2 and mu p = 170 m/s^2 against a slide of 2 m/s, which the onset
    # over 170 / 200 m/s weakens to 170 * 2 / 2.85 = 119.3 m/s^2.
    ball = one("obstacle", radius=0.1, center=(1.0, 0.0, 0.0), friction=0.5)
    _, after = flown(ball, [[1.0, 0.0, 0.09], [0.0, 0.0, 0.0]], [[2.0, 0.0, 0.0], [0.0] * 3], 1, substeps=1)
    assert after.velocity[0].tolist() == pytest.approx([2.0 - 1.19298, 0.0, 3.4], rel=1e-4)


# Sliding from 1 m/s stops after v^2 / 2 mu g; of friction c N v alone, after v / c g. Semi-implicit Euler moves with
# the speed after each step: h v / 2 = 0.25 mm less, and h v = 0.5 mm less.
STOPS: list[tuple[str, dict[str, float | tuple[float, ...]], float, float, float, float]] = [
    ("friction_scale", {"change": 0.5}, 0.4, 0.0, 0.0, 1 / (2 * 0.6 * G)),
    ("friction_scale", {"change": -0.5}, 0.4, 0.0, 0.0, 1 / (2 * 0.2 * G)),
    ("friction_viscous", {"coefficient": 1.0}, 0.0, 30.0, 0.0, 1 / G),
    ("friction_anisotropic", {"components": (0.5, 0.0)}, 0.4, 0.0, 0.0, 1 / (2 * 0.6 * G)),
    ("friction_anisotropic", {"components": (0.5, 0.0)}, 0.4, 90.0, 0.0, 1 / (2 * 0.2 * G)),
    ("friction_anisotropic", {"components": (0.5, 0.0)}, 0.4, 45.0, 0.0, 1 / (2 * 0.4 * G)),
    ("friction_anisotropic", {"components": (0.0, 0.5)}, 0.4, 45.0, 0.0, 1 / (2 * 0.6 * G)),
    ("friction_anisotropic", {"components": (0.0, 0.5)}, 0.4, 225.0, 0.0, 1 / (2 * 0.6 * G)),
    ("friction_drift", {"rate": 0.25}, 0.4, 0.0, 120.0, 1 / (2 * 0.6 * G)),
]


@pytest.mark.parametrize("id, values, friction, degrees, begin, distance", STOPS)
def test_friction_stops_a_slide(
    id: str, values: dict[str, float], friction: float, degrees: float, begin: float, distance: float
) -> None:
    assert stops(one(id, **values), [degrees], friction, begin)[0] == pytest.approx(distance, abs=5.5e-4)


def test_friction_patch_takes_the_energy_of_its_bell() -> None:
    # Across the middle, from 4 r before to 4 r behind: v^2 falls by 2 mu g (8 r + a r sqrt(2 pi)) = 1.277 from 4.
    sticky = one("friction_patch", change=2.0, center=(1.0, 5.0), radius=0.05)
    x, after = flown(sticky, [[0.8, 5.0, 0.0], [0.8, 0.0, 0.0]], [[2.0, 0.0, 0.0]] * 2, 22, Scene(ground=0.0), 0.1)
    more = float(x[-1, 0, 0]) - 1.2  # behind the patch there is plain friction
    expected = 4.0 - 2 * 0.1 * G * (0.4 + 2.0 * 0.05 * math.sqrt(2 * math.pi)) - 2 * 0.1 * G * more
    assert float(after.velocity[0, 0]) == pytest.approx(math.sqrt(expected), rel=2e-3)
    assert float(after.velocity[1, 0]) == pytest.approx(2.0 - 0.1 * G * 0.22, rel=1e-4)


def test_table_is_where_height_and_slope_say() -> None:
    place = [[0.5, -0.5, 0.2], [-1.0, 0.0, 0.2]]
    for extensions, expected in (
        (one("table_height", height=-0.03), [0.07, 0.07]),
        (one("table_tilt", slope=(0.02, -0.04)), [0.13, 0.08]),
    ):
        x, _ = flown(extensions, place, [[0.0] * 3] * 2, 60, Scene(ground=0.1))
        assert x[-1, :, 2].tolist() == pytest.approx(expected, abs=1e-6)


def test_masses_of_tip_and_gradient() -> None:
    # A tenth of the length is the tip: 0.06 kg (1 + 2/10); a gradient leaves the whole as heavy.
    body = line(30, 0.58)
    for id, values, whole, ends in (("tip_mass", {"change": 2.0}, 0.072, (1.0, 3.0)),
                                    ("mass_gradient", {"slope": 0.5}, 0.06, (0.75, 1.25))):  # fmt: skip
        mass = mass_of_worlds(body, [tuple(one(id, **values))], (LIBRARY[id],))[0]
        assert float(mass.sum()) == pytest.approx(whole, rel=1e-6)
        assert (mass[[0, -1]] / torch.as_tensor(body.mass)[[0, -1]]).tolist() == pytest.approx(list(ends), rel=1e-5)


BENDS: list[tuple[str, dict[str, float], float, float]] = [
    ("bending_scale", {"change": 0.7}, 1.7, 1.7),
    ("bending_gradient", {"slope": 0.8}, 0.8, 1.2),
    # Two widths off the middle of the piece: 1 + a exp(-2) at the other bend.
    ("bending_region", {"change": 3.0, "center": 0.25, "width": 0.25}, 4.0, 1.0 + 3.0 * math.exp(-2.0)),
]


@pytest.mark.parametrize("id, values, first, last", BENDS)
def test_bends_unbend_as_their_stiffness_says(id: str, values: dict[str, float], first: float, last: float) -> None:
    # A zigzag of five lets go: its ends start with the acceleration of the bend beside them, at s = 1/4 and 3/4.
    shape = zigzag(5, 0.05, 60.0)
    body = dataclasses.replace(line(5, 0.2), rest_position=shape)
    speed = []
    for extensions in ([], one(id, **values)):
        sim = SpringMass(body, Physics(bending_stiffness=1e-4), NOWHERE, substeps=1, extensions=extensions)
        _, after = sim.rollout_states(sim.start(state_of(shape)), nobody(1))
        speed.append(after.velocity.norm(dim=-1)[[0, -1]])
    assert (speed[1] / speed[0]).tolist() == pytest.approx([first, last], rel=1e-4)


# Two particles 0.11 m apart on a spring of 0.1 m and 60 N: 6 N at a strain of 0.1.
PULLS: list[tuple[str, dict[str, float], float]] = [
    ("strain_stiffening", {"growth": 25.0}, 7.2),  # 25 e^2 = 1/4 of 1 + 1/4: a fifth more
    ("strain_stiffening", {"growth": 1e5}, 6.0 * (1.0 + 1000.0 / 1001.0)),
    ("stretch_scale", {"change": 0.3}, 7.8),
    ("length_scale", {"change": 0.05}, 3.0),
    ("length_drift", {"rate": 0.05}, 3.0),  # a minute into the session
]


@pytest.mark.parametrize("id, values, tension", PULLS)
def test_springs_pull_as_their_law_says(id: str, values: dict[str, float], tension: float) -> None:
    body = line(2, 0.1, mass=2.0)
    sim = SpringMass(body, Physics(stiffness=60.0), NOWHERE, substeps=1, extensions=one(id, **values))
    state = begun(sim.start(state_of(body.rest_position * 1.1)), 60.0)
    _, after = sim.rollout_states(state, nobody(1))
    assert float(after.velocity[0, 0]) == pytest.approx(tension * 0.01 / 1.0, rel=1e-4)


Values = dict[str, tuple[float, ...]]
# What is hidden, and where the search begins: amounts that matter, places seen from afar.
PLANTED: dict[str, tuple[Values, Values]] = {
    "wind": (
        {"coefficient": (0.3,), "velocity": (3.0, -2.0), "along": (0.4,)},
        {"coefficient": (0.1,), "velocity": (1.0, -1.0), "along": (0.1,)},
    ),
    "attraction": (
        {"strength": (2.0,), "center": (0.2, 0.15, -0.3), "range": (0.12,)},
        {"strength": (0.5,), "center": (0.1, 0.1, -0.2), "range": (0.15,)},
    ),
    "tether": (
        {"stiffness": (0.5,), "arc": (0.7,), "anchor": (0.3, 0.3, -0.3), "length": (0.25,)},
        {"stiffness": (0.2,), "arc": (0.75,), "anchor": (0.2, 0.2, -0.2), "length": (0.2,)},
    ),
    "obstacle": (
        {"radius": (0.08,), "center": (0.3, 0.05, -0.15), "friction": (0.3,)},
        {"radius": (0.06,), "center": (0.32, 0.04, -0.13), "friction": (0.5,)},
    ),
    "friction_scale": ({"change": (0.5,)}, {"change": (0.0,)}),
    "friction_viscous": ({"coefficient": (2.0,)}, {"coefficient": (0.0,)}),
    "friction_anisotropic": ({"components": (0.4, -0.3)}, {"components": (0.0, 0.0)}),
    "friction_patch": (
        {"change": (2.0,), "center": (0.3, 0.05), "radius": (0.1,)},
        {"change": (1.0,), "center": (0.25, 0.0), "radius": (0.08,)},
    ),
    "table_height": ({"height": (0.02,)}, {"height": (0.0,)}),
    "table_tilt": ({"slope": (0.05, -0.04)}, {"slope": (0.0, 0.0)}),
    "friction_drift": ({"rate": (0.4,)}, {"rate": (0.0,)}),
    "tip_mass": ({"change": (1.0,)}, {"change": (0.0,)}),
    "mass_gradient": ({"slope": (0.8,)}, {"slope": (0.0,)}),
    "bending_scale": ({"change": (0.8,)}, {"change": (0.0,)}),
    "bending_gradient": ({"slope": (1.0,)}, {"slope": (0.0,)}),
    "bending_region": (
        {"change": (3.0,), "center": (0.35,), "width": (0.1,)},
        {"change": (1.0,), "center": (0.45,), "width": (0.1,)},
    ),
    "strain_stiffening": ({"growth": (200.0,)}, {"growth": (50.0,)}),
    "stretch_scale": ({"change": (0.5,)}, {"change": (0.0,)}),
    "length_drift": ({"rate": (0.02,)}, {"rate": (0.0,)}),
    "length_scale": ({"change": (0.02,)}, {"change": (0.0,)}),
}
ON_TABLE = [id for id in PLANTED if LIBRARY[id].hooks == ("contact",)]
NOISE = 1e-4  # [m] standard deviation of a coordinate


def seen(id: str) -> Callable[[list[Values]], Tensor]:
    """Simulates worlds with these values: positions (W, T * N * 3) of a held line that swings, or drags on a table."""
    body: Body = line(30, 0.58, mass=0.05, radius=0.004)
    table = id in ON_TABLE
    scene = Scene(ground=-0.03) if table else Scene()
    physics = Physics(stiffness=30.0, damping=0.05, bending_stiffness=3e-4, ground_friction=0.4)
    t = torch.arange(1, 121)[:, None] * 0.01
    # Pulled over the table, not pushed: a line that buckles is chaos.
    along = -0.25 * t.square() if table else 0.1 * torch.sin(5 * t)
    place = torch.stack((along, 0.12 * torch.sin(4 * t), 0.03 * torch.sin(7 * t).square()), -1)
    turn = torch.stack((0 * t, 0.4 * torch.sin(3 * t), 0.5 * torch.sin(4 * t)), -1)

    def simulate(values: list[Values]) -> Tensor:
        worlds = [LIBRARY[id].extension(**v) for v in values]
        sim = SpringMass(body, physics, scene, extensions=[(e,) for e in worlds], substeps=24)
        start = state_of(np.stack([body.rest_position] * len(worlds)))
        state = sim.start(holding(start, {0: 0, 1: 0}), still(torch.zeros(len(worlds), 1, 3)))
        grips = Grip(place, quaternion_from_rotation_vector(turn), torch.ones(len(t), 1, dtype=torch.bool))
        return sim.rollout(begun(state, 60.0), grips).transpose(0, 1).flatten(1).double()

    return simulate


@pytest.mark.parametrize("id", PLANTED)
def test_planted_value_is_found(id: str) -> None:
    planted, begin = PLANTED[id]
    names = [(q, k) for q in LIBRARY[id].parameters for k in range(q.size)]
    scale = np.array([q.typical * (q.null if q.log else 1.0) for q, _ in names])
    simulate = seen(id)

    def values(z: np.ndarray) -> Values:
        out: dict[str, list[float]] = {q.name: [] for q in LIBRARY[id].parameters}
        for (q, _), number in zip(names, z * scale, strict=True):
            out[q.name].append(min(max(float(number), q.low), q.high))
        return {k: tuple(v) for k, v in out.items()}

    def coordinates(v: Values) -> np.ndarray:
        return np.concatenate([v[q.name] for q in LIBRARY[id].parameters]) / scale

    data = simulate([planted])[0]
    data = data + NOISE * torch.as_tensor(np.random.default_rng(0).normal(size=len(data)))

    def residual(z: np.ndarray) -> np.ndarray:
        return (simulate([values(z)])[0] - data).numpy()

    def jacobian(z: np.ndarray) -> np.ndarray:
        # Central differences, all in one batch.
        steps = 0.02 * np.eye(len(z))
        x = simulate([values(z + s) for s in steps] + [values(z - s) for s in steps]).numpy()
        return (x[: len(z)] - x[len(z) :]).T / 0.04

    found = least_squares(residual, coordinates(begin), jacobian, loss="soft_l1", f_scale=0.01, max_nfev=40)
    for name, value in values(found.x).items():
        assert math.dist(value, planted[name]) < 0.02 * math.hypot(*planted[name]), (name, value)


def everything(ids: list[str], amount: float = 1.0) -> tuple[Extension, ...]:
    """These effects at once, at a share of their planted changes."""
    out = []
    for id in ids:
        shares = {q.name: (np.array(PLANTED[id][0][q.name]) - q.null) * amount + q.null
                  for q in LIBRARY[id].parameters}  # fmt: skip
        out.append(LIBRARY[id].extension(**{k: tuple(v.tolist()) for k, v in shares.items()}))
    return tuple(out)


# One after the other, in lanes, and in the stages of CUDA.
@pytest.mark.parametrize(("worlds", "staged"), [(2, False), (5, False), (2, True)])
def test_all_laws_together_equal_the_reference(worlds: int, staged: bool) -> None:
    body, scene = line(12, 0.55, radius=0.004), Scene(ground=-0.006)
    physics = [Physics(stiffness=60.0, damping=0.1, bending_stiffness=2e-4, ground_friction=0.1 * w)
               for w in range(1, worlds + 1)]  # fmt: skip
    extensions = [everything(list(PLANTED), 0.3 + 0.1 * w) for w in range(worlds)]
    sim = SpringMass(body, physics, scene, extensions=extensions, substeps=20, staged=staged)
    twin = Reference(body, physics, scene, substeps=20, extensions=extensions)
    rng = np.random.default_rng(0)
    speed = rng.normal(size=(worlds, 12, 3)) * 0.3
    state = holding(state_of(np.stack([body.rest_position] * worlds), speed), {0: 0, 1: 0})
    begin = begun(sim.start(state, still(torch.zeros(worlds, 1, 3))), 60.0)
    grips = still(torch.zeros(worlds, 1, 3), 6)
    x, after = sim.rollout_states(begin, grips)
    expected, velocity = twin.rollout(begin, grips)
    # Float32 against float64 over 120 substeps.
    assert float((x - expected).abs().max()) < 2e-6
    assert float((after.velocity - velocity).abs().max()) < 2e-4


def test_what_acts_within_the_object_keeps_its_momentum() -> None:
    within = [id for id in PLANTED if set(LIBRARY[id].hooks) <= {"spring", "bend_stiffness", "inertia"}]
    assert len(within) == 9
    body, extensions = line(12), everything(within)
    mass = mass_of_worlds(body, [extensions], tuple(LIBRARY[id] for id in within))[0][:, None].double()
    sim = SpringMass(body, Physics(stiffness=60.0, damping=0.1, bending_stiffness=2e-4), NOWHERE, extensions=extensions)
    speed = np.random.default_rng(0).normal(size=(12, 3)) * 0.3
    begin = begun(sim.start(state_of(body.rest_position, speed)), 60.0)
    _, after = sim.rollout_states(begin, nobody(50))
    lost = (mass * (after.velocity - begin.velocity).double()).sum(0)
    assert float(lost.norm()) < 1e-5 * float((mass * begin.velocity.double().abs()).sum())


def test_no_friction_law_speeds_anything_up() -> None:
    place = [[0.1 * n, 0.02 * n, 0.0] for n in range(8)]
    velocity = np.random.default_rng(0).normal(size=(8, 3)) * [0.5, 0.5, 0.0]
    laws = everything([id for id in ON_TABLE if not id.startswith("table")], 0.5)
    sim = SpringMass(particles(np.array(place)), Physics(ground_friction=0.2), Scene(ground=0.0), extensions=laws)
    state = sim.start(state_of(np.array(place), velocity))
    speeds = [state.velocity.norm(dim=-1)]
    for _ in range(60):
        state = sim.step(state, nobody())
        speeds.append(state.velocity.norm(dim=-1))
    assert bool((torch.stack(speeds).diff(dim=0) <= 1e-7).all())
    assert float(speeds[-1].max()) == 0.0

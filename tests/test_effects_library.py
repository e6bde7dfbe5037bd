"""What every effect of the library promises, and what each law does. New effects are covered by the first tests."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from springmass_cases import NOWHERE, holding, line, nobody, particles, state_of, still, zigzag
from torch import Tensor

from pred_core.effects import LIBRARY, confounded
from pred_core.effects.algebra import Code, Traced, Vec3, where
from pred_core.effects.effect import HOOKS, BendContext, Effect
from pred_core.errors import TwinError
from pred_core.frames import quaternion_from_rotation_vector
from pred_core.springmass import SpringMass
from pred_core.twin import Extension
from pred_core.types import Grip, Physics, Scene, State

PHYSICS = Physics(stiffness=60.0, damping=0.1, ground_friction=0.4, bending_stiffness=2e-4)
INTERNAL = ("bending_damping", "bending_hysteresis")
simulated = pytest.mark.parametrize("effect", [e for e in LIBRARY.values() if set(e.hooks) - {"observe"}],
                                    ids=lambda e: e.id)  # fmt: skip


def swung(worlds: int, extensions: tuple[Extension, ...], substeps: int | None = None) -> Tensor:
    """Trajectories of a held line that swings, turns with its gripper and touches the ground."""
    rng = np.random.default_rng(0)
    body = line(radius=0.003)
    sim = SpringMass(body, PHYSICS, Scene(ground=-0.02), extensions=extensions, substeps=substeps)
    flung = state_of(np.stack([body.rest_position] * worlds), rng.normal(size=(worlds, 12, 3)) * 0.3)
    state = holding(flung, {0: 0, 1: 0})
    turn = quaternion_from_rotation_vector(torch.linspace(0.05, 1, 20)[:, None, None] * torch.tensor([0.3, 0.5, -0.4]))
    place = torch.linspace(0.05, 1, 20)[:, None, None] * torch.tensor([0.05, -0.1, 0.02])
    grips = Grip(place, turn, torch.ones(20, 1, dtype=torch.bool))
    return sim.rollout(sim.start(state, still(torch.zeros(worlds, 1, 3))), grips)


@simulated
def test_null_values_reproduce_the_base_bit_for_bit(effect: type[Effect]) -> None:
    null = effect.extension()
    effect.check(null)
    for worlds in (1, 5):  # alone, and in lanes
        assert torch.equal(swung(worlds, (null,)), swung(worlds, ()))


@simulated
def test_other_values_change_the_motion_and_stay_finite(effect: type[Effect]) -> None:
    base = swung(3, ())
    for q in effect.parameters:
        away = q.high if not math.isfinite(q.typical) else q.null + q.typical
        away = away if q.low <= away <= q.high else q.null - q.typical
        values: dict[str, float | tuple[float, ...]] = {
            o.name: (min(max(o.null + o.typical, o.low), o.high),) * o.size for o in effect.parameters
        }
        values[q.name] = (away,) * q.size
        changed = swung(3, (effect.extension(**values),))
        assert torch.isfinite(changed).all()
        assert float((changed - base).abs().max()) > 1e-7, q.name


@pytest.mark.parametrize("effect", LIBRARY.values(), ids=lambda e: e.id)
def test_declaration_is_complete_and_bounds_hold(effect: type[Effect]) -> None:
    assert LIBRARY[effect.id] is effect and effect.__doc__ and effect.family
    assert effect.hooks and set(effect.hooks) <= set(HOOKS)
    for q in effect.parameters:
        assert q.low < q.high and q.unit and q.doc
        for value in (q.high * 1.01 + 1e-6, q.low - abs(q.low) * 0.01 - 1e-6, math.nan, math.inf):
            if value == q.null:
                continue
            bad = effect.null() | {q.name: (value,) + (q.null,) * (q.size - 1)}
            with pytest.raises(TwinError, match=q.name):
                effect.check(Extension(effect.id, effect.version, bad))
        with pytest.raises(TwinError, match=q.name):
            effect.check(Extension(effect.id, effect.version, effect.null() | {q.name: (q.null,) * (q.size + 1)}))
    with pytest.raises(TwinError, match="no parameter"):
        effect.extension(nonsense=1.0)
    with pytest.raises(TwinError, match="version"):
        effect.check(Extension(effect.id, effect.version + 1, effect.null()))


STRONG: dict[str, dict[str, float | tuple[float, ...]]] = {
    "drag_linear": {"coefficient": 20.0},
    "drag_quadratic": {"coefficient": 20.0},
    "drag_power": {"coefficient": 20.0, "power": 3.0},
    "gravity_offset": {"acceleration": (3.0, -3.0, 3.0)},
    "bending_damping": {"time": 0.3},
    "bending_hysteresis": {"ratio": 10.0, "reach": 0.3},
    "rest_curvature": {"first": (1.0, -1.0) * 6, "second": (0.5,) * 12, "twist": 1.0},
    "bending_profile": {"relative": (3.0, 0.0) * 6},
    "mass_profile": {"relative": (-0.7, 1.0) * 6},
    "stiffness_drift": {"rate": -3.0},
    "bending_creep": {"rate": 20.0},
    "rest_bow": {"curvature": (6.0, -4.0)},
    "bending_stiffening": {"gain": 1e-3},
    "bending_plasticity": {"radius": 0.5},
    "gripper_offset": {"offset": (0.05, -0.05, 0.05)},
    "gripper_rotation": {"rotation": (0.3, -0.5, 0.4)},
    "grip_slip": {"weakness": 0.4, "damping": 5.0},
    "wind": {"coefficient": 2.0, "velocity": (6.0, -6.0)},
    "attraction": {"strength": 20.0, "center": (0.2, 0.1, -0.1), "range": 0.05},
    "tether": {"stiffness": 50.0, "arc": 0.9, "anchor": (0.3, 0.3, 0.0), "length": 0.1},
    "obstacle": {"radius": 0.1, "center": (0.3, 0.0, -0.15)},
    "friction_scale": {"change": 5.0},
    "friction_viscous": {"coefficient": 50.0},
    "friction_power": {"coefficient": 50.0, "power": 2.0},
    "friction_anisotropic": {"components": (2.0, -2.0)},
    "friction_patch": {"change": 20.0, "radius": 0.5},
    "table_height": {"height": 0.1},
    "tip_mass": {"change": 10.0},
    "mass_gradient": {"slope": 1.9},
    "bending_scale": {"change": 2.0},
    "bending_region": {"change": 5.0, "center": 0.3, "width": 0.05},
    "friction_drift": {"rate": 10.0},
    "table_tilt": {"slope": (0.2, 0.2)},
    "bending_gradient": {"slope": -1.9},
    "strain_stiffening": {"growth": 1e5},
    "stretch_scale": {"change": 1.5},
    "length_drift": {"rate": 0.2},
    "length_scale": {"change": -0.1},
    "delay": {"delay": 0.25},
    "camera_scale": {"scale": 0.2, "center": (0.9, 0.0, 0.8)},
    "camera_rotation": {"rotation": (0.2, -0.2, 0.2), "center": (0.9, 0.0, 0.8)},
}


WITHIN = ("bend", "bend_stiffness", "spring", "inertia")  # hooks that change what the object is made of
# To the choice of substeps these are another effect in another form: alone only.
ALIKE = (
    "rest_bow", "bending_scale", "bending_region", "bending_gradient", "tip_mass", "mass_gradient", "stretch_scale",
    "length_drift", "bending_plasticity",
)  # fmt: skip


def _together(pair: tuple[str, str]) -> bool:
    """One alone that acts off the ground; of two, both within the object and one through its bends."""
    first, second = (set(LIBRARY[id].hooks) for id in pair)
    if pair[0] == pair[1]:
        return bool(first & {"force", "boundary", *WITHIN})
    if set(pair) & set(ALIKE):
        return False
    return "bend" in first | second and bool(first & set(WITHIN)) and bool(second & set(WITHIN))


PAIRS = [pair for pair in itertools.combinations_with_replacement(sorted(LIBRARY), 2) if _together(pair)]


@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_strong_effects_together_stay_bounded_at_the_chosen_substeps(pair: tuple[str, str]) -> None:
    body = line(13, 0.6)
    extensions = [LIBRARY[id].extension(**STRONG[id]) for id in dict.fromkeys(pair)]
    physics = Physics(stiffness=60.0, damping=0.1, bending_stiffness=3e-3)
    bent = zigzag(13, 0.05, 90.0) + np.random.default_rng(0).normal(size=(13, 3)) * 1e-3
    # A little damping: a set works against the frame that carries it without inertia, and drives an undamped line.
    sim = SpringMass(body, physics, extensions=extensions)
    clamp = still(torch.tensor(bent[:1], dtype=torch.float32))
    state = sim.start(holding(state_of(bent), {0: 0, 1: 0}), clamp)
    x, after = sim.rollout_states(state, still(torch.tensor(bent[:1], dtype=torch.float32), 100))
    # A line of 0.6 m stays within reach of its clamp, stretched by a fifth at most, and no faster than what it stored:
    # 1.3 J in bends and 0.06 kg 9.8 m/s^2 0.6 m in height, all in one particle of 5 g, would be 26 m/s.
    assert float((x - x[0, 0]).norm(dim=-1).max()) < 1.2 * 0.6
    assert float(after.velocity.norm(dim=-1).max()) < 26.0


def test_strong_values_are_given_for_every_effect() -> None:
    assert set(STRONG) == set(LIBRARY)


def test_values_that_do_not_fit_are_refused() -> None:
    effect = LIBRARY["mass_profile"]
    assert effect.extension(relative=(0.5,)).parameters["relative"] == (0.5,) + (0.0,) * 11
    with pytest.raises(TwinError, match="at most 12"):
        effect.extension(relative=(0.1,) * 13)
    bad: list[Any] = [(0.1,) * 11, (0.1,) * 11 + ("0.1",), (0.1,) * 11 + (True,), (-0.8,) * 12]
    for values in bad:
        with pytest.raises(TwinError, match="relative"):
            effect.check(Extension(effect.id, effect.version, {"relative": values}))


def test_drag_gives_terminal_velocity() -> None:
    # b = 5 /s: v = g/b = 1.962 m/s, whatever the mass; the discrete fixed point is the same.
    body = dataclasses.replace(particles(np.array([[0.0, 0, 0], [1, 0, 0]])), mass=np.array([0.01, 1.0]))
    sim = SpringMass(body, PHYSICS, extensions=[LIBRARY["drag_linear"].extension(coefficient=5.0)], substeps=10)
    _, after = sim.rollout_states(sim.start(state_of(body.rest_position)), nobody(400))
    assert after.velocity[:, 2].tolist() == pytest.approx([-1.962, -1.962], rel=1e-5)


def test_gravity_offset_is_tilted_gravity() -> None:
    body = line()
    offset = LIBRARY["gravity_offset"].extension(acceleration=(1.0, -2.0, 0.5))
    state = state_of(body.rest_position, np.random.default_rng(0).normal(size=(12, 3)) * 0.1)
    ways = []
    for scene, extensions in ((Scene(), [offset]), (Scene(gravity=(1.0, -2.0, -9.31)), [])):
        sim = SpringMass(body, PHYSICS, scene, extensions=extensions, substeps=20)
        ways.append(sim.rollout(sim.start(state), nobody(20)))
    assert float((ways[0] - ways[1]).abs().max()) < 1e-6


def motion(body: object, state: State) -> tuple[float, Tensor, Tensor]:
    """Kinetic energy, momentum, angular momentum."""
    m = torch.as_tensor(body.mass)[:, None]  # type: ignore[attr-defined]
    x, v = state.position.double(), state.velocity.double()
    return float((0.5 * m * v * v).sum()), (m * v).sum(0), (m * torch.linalg.cross(x, v)).sum(0)


def arc(count: int, radius: float, angle: float) -> np.ndarray:
    a = np.linspace(0, angle, count)
    return np.stack((radius * np.sin(a), radius * np.cos(a), 0 * a), axis=1)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 6.0), (4.0, 1.0, 0.0)])
def test_bending_damping_does_nothing_in_rigid_motion(axis: tuple[float, ...]) -> None:
    # A curved free rod without bending moments would fly apart; stiff springs across keep its shape while it turns.
    shape = arc(12, 0.2, 2.0)
    shape -= shape.mean(0)
    body = line()
    pairs = np.array([(i, j) for i in range(12) for j in range(i + 1, 12)], np.int32)
    length = np.linalg.norm(shape[pairs[:, 1]] - shape[pairs[:, 0]], axis=1)
    ones = np.ones(len(pairs))
    body = dataclasses.replace(body, rest_position=shape, springs=pairs, rest_length=length, stiffness_scale=ones,
                               damping_scale=0 * ones)  # fmt: skip
    spin = np.cross(np.array(axis), shape)
    kept = []
    for time in (0.0, 0.5):
        sim = SpringMass(body, Physics(stiffness=200.0, bending_stiffness=1e-4), NOWHERE, substeps=200,
                         extensions=[LIBRARY["bending_damping"].extension(time=time)])  # fmt: skip
        start = sim.start(state_of(shape, spin))
        _, after = sim.rollout_states(start, nobody(60))
        kept.append(motion(body, after)[0] / motion(body, start)[0])
    # It turns by two radians or more; a frame that does not turn with the rod would lose most of the energy.
    assert kept[1] == pytest.approx(kept[0], abs=0.02)
    assert kept[1] > 0.9


@pytest.mark.parametrize("id", INTERNAL)
def test_internal_effects_keep_momentum(id: str) -> None:
    body = line()
    typical = {"bending_damping": {"time": 0.02}, "bending_hysteresis": {"ratio": 2.0, "reach": 0.1}}[id]
    sim = SpringMass(body, PHYSICS, NOWHERE, extensions=[LIBRARY[id].extension(**typical)])
    flat = np.random.default_rng(0).normal(size=(12, 3)) * [1.0, 1.0, 0.0] * 0.3  # plane: moments along one axis
    start = sim.start(state_of(body.rest_position, flat))
    _, after = sim.rollout_states(start, nobody(30))
    _, p0, l0 = motion(body, start)
    _, p1, l1 = motion(body, after)
    assert float((p1 - p0).norm() / p0.norm()) < 1e-5
    assert float((l1 - l0).norm() / l0.norm()) < 1e-4  # the frame's arctangent is good to 1e-5
    # Out of the plane the frame transmits torsion without inertia: linear momentum only.
    start = sim.start(state_of(body.rest_position, np.random.default_rng(1).normal(size=(12, 3)) * 0.3))
    _, after = sim.rollout_states(start, nobody(30))
    assert float((motion(body, after)[1] - motion(body, start)[1]).norm()) < 1e-5


@pytest.mark.parametrize("seconds", [0.5, 2.0])
def test_hysteresis_dissipates_at_any_speed_and_leaves_a_set(seconds: float) -> None:
    """The law alone, on tensors: bent and straightened again, slowly or fast."""
    effect = LIBRARY["bending_hysteresis"]
    # Curvature goes 0 -> 0.3 -> 0 in n steps; dz = dk - |dk| z / c.
    n = round(seconds * 200)
    z, work = (torch.zeros(()), torch.zeros(())), 0.0
    p = {"ratio": (torch.tensor(2.0),), "reach": (torch.tensor(0.05),)}
    last = 0.0
    for k in [*np.linspace(0, 0.3, n)[1:], *np.linspace(0.3, 0, n)[1:]]:
        step = torch.tensor(k - last)
        zero = torch.zeros(())
        at = BendContext((torch.tensor(k), zero), (step, zero), torch.tensor(1.0), torch.tensor(0.05),
                         torch.tensor(1.0), torch.tensor(1e-3), torch.tensor(0.5), zero, z)  # fmt: skip
        m1, _, z = effect.bend(p, at)
        work += float(m1 * step)
        last = float(k)
    # Dahl, loading to saturation and back: z = c tanh-like exponential; the loop's area is 2 a c (0.3 - 2 c) to O(c^2).
    assert work == pytest.approx(2 * 2.0 * 0.05 * (0.3 - 0.05 * (1 + math.log(2.0))), rel=0.1)
    assert float(m1) < -0.09  # a c = 0.1 N m against straightening again: the permanent set


def test_hysteresis_leaves_a_bent_line_bent() -> None:
    """A line bent by gravity, then freed of it, keeps part of its bend only with hysteresis."""
    body = line(mass=0.02)
    sag = {}
    for ratio in (0.0, 4.0):
        extensions = [LIBRARY["bending_hysteresis"].extension(ratio=ratio, reach=0.02),
                      LIBRARY["drag_linear"].extension(coefficient=6.0)]  # fmt: skip
        physics = Physics(stiffness=60.0, damping=0.1, bending_stiffness=2e-3)
        clamp = still(torch.zeros(1, 3))
        loaded = SpringMass(body, physics, Scene(), extensions=extensions)
        state = loaded.start(holding(state_of(body.rest_position), {0: 0, 1: 0}), clamp)
        _, state = loaded.rollout_states(state, still(torch.zeros(1, 3), 400))
        bent = -float(state.position[-1, 2])
        free = SpringMass(body, physics, NOWHERE, extensions=extensions, substeps=loaded.substeps)
        x, _ = free.rollout_states(state, still(torch.zeros(1, 3), 600))
        sag[ratio] = -float(x[-1, -1, 2]) / bent
    assert abs(sag[0.0]) < 0.02
    assert sag[4.0] > 0.05


def test_algebra_writes_and_computes_the_same() -> None:
    def law(a: object, b: object) -> object:
        v = Vec3(a, b, 1.0) * 2.0
        return where(a > 0.5, v.dot(v.cross(Vec3(1.0, a, b))) - 3.0 / b, -v.norm())  # type: ignore[operator]

    code = Code("t")
    assert isinstance(law(Traced(code, "a"), Traced(code, "b")), Traced)
    assert all(line.startswith("const ") for line in code.lines)
    # By hand for a = 1, b = 2: v = (2, 4, 2), cross (1, 1, 2) = (6, -2, -2), dot = 0, minus 3 / 2.
    assert float(law(torch.tensor(1.0), torch.tensor(2.0))) == pytest.approx(-1.5)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="traced"):
        Traced(code, "a") + torch.tensor(1.0)


def test_confusion_goes_both_ways() -> None:
    for id in LIBRARY:
        assert id not in confounded(id) and len(set(confounded(id))) == len(confounded(id))
        for other in confounded(id):
            assert other not in LIBRARY or id in confounded(other)

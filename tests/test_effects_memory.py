"""Effects that remember or change with time, and effects of the grip: their laws by hand, and found again.

Every planted value is found through the simulator itself, without noise: what is left is float32, far below the 2 %
asked for.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from springmass_cases import NOWHERE, holding, line, state_of, still
from torch import Tensor

from pred_core.effects import LIBRARY
from pred_core.effects.effect import BendContext
from pred_core.errors import InputError
from pred_core.frames import quaternion_from_rotation_vector
from pred_core.springmass import SpringMass
from pred_core.springmass.reference import Reference
from pred_core.twin import Extension
from pred_core.types import Grip, Physics, Scene, State

PHYSICS = Physics(stiffness=60.0, damping=0.3, ground_friction=0.4, bending_stiffness=1e-3)
ALL: dict[str, dict[str, Any]] = {
    "bending_creep": {"rate": 2.0},
    "bending_plasticity": {"radius": 0.3},
    "rest_bow": {"curvature": (2.0, -1.0)},
    "bending_stiffening": {"gain": 0.02},
    "stiffness_drift": {"rate": 1.5},
    "gripper_offset": {"offset": (0.004, -0.01, 0.006)},
    "gripper_rotation": {"rotation": (0.2, -0.1, 0.3)},
    "grip_slip": {"weakness": 2.0, "damping": 2.0},
}
EXTENSIONS = [LIBRARY[id].extension(**values) for id, values in ALL.items()]


def swing(worlds: int, periods: int = 24, seed: int = 0) -> tuple[State, Grip, Grip]:
    """A line held by its first two particles, 3 cm beside its gripper, which swings and turns, else in each world."""
    rng = np.random.default_rng(seed)
    body = line()
    state = state_of(np.stack([body.rest_position] * worlds), rng.normal(size=(worlds, 12, 3)) * 0.2)
    t = torch.linspace(0.0, 1.0, periods + 1)[1:, None, None, None]
    way = torch.tensor(rng.normal(size=(worlds, 1, 3)), dtype=torch.float32)
    place = 0.06 * torch.sin(2.0 * math.pi * t) * way
    turn = quaternion_from_rotation_vector(1.5 * torch.sin(math.pi * t) * way.flip(-1))
    closed = torch.ones(periods, worlds, 1, dtype=torch.bool)
    origin = torch.tensor([0.0, 0.03, 0.0]).expand(worlds, 1, 3)
    return holding(state, {0: 0, 1: 0}), still(origin), Grip(origin + place, turn, closed)


def at_time(state: State, seconds: float) -> State:
    """The started state, at a later time of the session."""
    return state.replace(memory={**state.memory, "time": torch.full_like(state.memory["time"], seconds)})


def part(grips: Grip, begin: int, end: int) -> Grip:
    return Grip(grips.position[begin:end], grips.rotation[begin:end], grips.closed[begin:end])


@pytest.mark.parametrize("staged", [False, True])
@pytest.mark.parametrize("worlds", [1, 5])
def test_a_rollout_in_pieces_equals_the_whole_bit_for_bit(worlds: int, staged: bool) -> None:
    state, first, grips = swing(worlds)
    sim = SpringMass(line(), PHYSICS, extensions=EXTENSIONS, substeps=30, staged=staged)
    begun = at_time(sim.start(state, first), 61.7)
    whole, last = sim.rollout_states(begun, grips)
    now, pieces = begun, []
    for begin, end in ((0, 1), (1, 8), (8, 9), (9, 24)):
        x, now = sim.rollout_states(now, part(grips, begin, end))
        pieces.append(x)
    assert torch.equal(torch.cat(pieces), whole)
    assert torch.equal(now.velocity, last.velocity)
    assert all(torch.equal(now.memory[key], value) for key, value in last.memory.items())
    # The other schedule and the other width of registers: the same numbers.
    other = SpringMass(line(), PHYSICS, extensions=EXTENSIONS, substeps=30, staged=not staged)
    assert torch.equal(other.rollout(begun, grips), whole)


@pytest.mark.parametrize("held", [{0: 0, 1: 0}, {0: 0, 1: 0, 11: 1}, {}])
@pytest.mark.parametrize("worlds", [2, 5])
def test_the_kernel_equals_its_reference(worlds: int, held: dict[int, int]) -> None:
    # One gripper lets go in one world and takes again, so that its memory begins anew.
    state, first, grips = swing(worlds, 8)
    far = torch.tensor([0.55, 0.0, 0.0]).expand(8, worlds, 1, 3)
    grips = Grip(torch.cat((grips.position, far), 2), grips.rotation.repeat(1, 1, 2, 1), grips.closed.repeat(1, 1, 2))
    first = Grip(torch.cat((first.position, far[0]), 1), first.rotation.repeat(1, 2, 1), first.closed.repeat(1, 2))
    grips.closed[3:5, 1, 0] = False
    scene = Scene(grasp_radius=0.08)
    state = holding(state.replace(held=torch.full_like(state.held, -1)), held)
    physics = [dataclasses.replace(PHYSICS, stiffness=60.0 + w) for w in range(worlds)]
    slips = [LIBRARY["grip_slip"].extension(weakness=2.0 + w, damping=2.0) for w in range(worlds)]
    per_world = [[*EXTENSIONS[:-1], slip] for slip in slips]
    sim = SpringMass(line(), physics, scene, extensions=per_world, substeps=30)
    twin = Reference(line(), physics, scene, period=sim.period, substeps=30, extensions=per_world)
    begun = at_time(sim.start(state, first), 30.0)
    positions, after = sim.rollout_states(begun, grips)
    expected, velocity = twin.rollout(begun, grips)
    # As in test_springmass_reference: float32 over 0.08 s; stick or slip may differ by a substep of 1e-3 m/s.
    assert float((positions - expected).abs().max()) < 2e-5
    assert float((after.velocity - velocity).abs().max()) < 1e-2


def bend(id: str, kb: float, memory: tuple[float, ...] = (), rest: float = 0.0, **values: Any) -> tuple[Any, ...]:
    """(moment, memory) along the first axis for a curvature kb of a 5 cm edge with EI/l = 1, a substep of 10 ms."""
    effect = LIBRARY[id]
    p = {k: tuple(torch.tensor(v) for v in row) for k, row in effect.extension(**values).parameters.items()}

    def t(value: float) -> Tensor:
        return torch.tensor(value, dtype=torch.float64)

    kept = tuple(t(m) for m in memory)
    at = BendContext(curvature=(t(kb), t(0.0)), change=(t(0.0), t(0.0)), weight=t(1.0), length=t(0.05),
                     bends=t(1.0), substep=t(0.01), arc=t(0.5), time=t(120.0), memory=kept,
                     rest=(t(rest), t(0.0)), handed=(t(0.0),) * effect.line_values,
                     arrived=(t(0.0),) * effect.line_values)  # fmt: skip
    moment, _, memory_after = effect.bend(p, at)
    return float(moment), [float(m) for m in memory_after]


def test_bending_laws_by_hand() -> None:
    # Creep at 2 /s: 0.02/1.02 of what is missing to the elastic curvature 0.4 - 0.1 - 0.05, then k0 as a moment.
    moment, kept = bend("bending_creep", 0.4, (0.05, 0.0), rest=0.1, rate=2.0)
    assert kept[0] == pytest.approx(0.05 + 0.25 * 0.02 / 1.02) and moment == pytest.approx(-kept[0])
    # R = 0.25 m yields at l/R = 0.2: of 0.4 - 0.05 elastic 0.2 stay elastic, 0.15 flow.
    moment, kept = bend("bending_plasticity", 0.4, (0.05, 0.0), radius=0.25)
    assert kept[0] == pytest.approx(0.2) and moment == pytest.approx(-0.2)
    assert bend("bending_plasticity", 0.24, (0.05, 0.0), radius=0.25)[1][0] == pytest.approx(0.05)
    # 3 /m on an edge of 0.05 m.
    assert bend("rest_bow", 0.0, (0.0,), curvature=(3.0,))[0] == pytest.approx(-0.15)
    # kappa = 0.2/0.05 = 4 /m, a = 0.0625 m^2: x = 1, saturating at 4: 0.8 of EI more; a = -0.0625: 1/2.25 less.
    assert bend("bending_stiffening", 0.2, gain=0.0625)[0] == pytest.approx(0.8 * 0.2)
    assert bend("bending_stiffening", 0.2, gain=-0.0625)[0] == pytest.approx(-0.2 / 2.25)
    drift = LIBRARY["stiffness_drift"]
    for rate, relative in ((0.3, 0.6), (-0.3, -0.6), (-1.0, -0.95), (3.0, 6.0)):
        p = {"rate": (torch.tensor(rate),)}
        assert float(drift.bend_stiffness(p, torch.tensor(0.5), torch.tensor(120.0))) == pytest.approx(relative)


def test_stiffness_drift_is_a_stiffness_at_a_time_of_the_session() -> None:
    state, first, grips = swing(2)
    drift = SpringMass(line(), PHYSICS, extensions=[LIBRARY["stiffness_drift"].extension(rate=0.3)], substeps=30)
    x = drift.rollout(at_time(drift.start(state, first), 120.0), grips)
    stiff = SpringMass(line(), dataclasses.replace(PHYSICS, bending_stiffness=1.6e-3), substeps=30)
    off = float((stiff.rollout(stiff.start(state, first), grips) - x).abs().max())
    soft = SpringMass(line(), PHYSICS, substeps=30)
    usual = float((soft.rollout(soft.start(state, first), grips) - x).abs().max())
    # EI is 1.6 times as much at 120 s, and 0.0012 more after the 0.24 s: a 500th of the change.
    assert usual > 3e-3 and off < usual / 200


@pytest.mark.parametrize(("id", "far"), [("bending_creep", 2.0), ("bending_plasticity", 0.3)])
def test_a_line_keeps_what_it_was_bent_to_beyond_elastic(id: str, far: float) -> None:
    """Both ends turned by a radian and back: the moment that is left is that of the rest shape."""
    body = line(length=0.55)
    flat = state_of(body.rest_position)
    turn = torch.cat((torch.linspace(0.0, 1.0, 60), torch.ones(60), torch.linspace(1.0, 0.0, 60), torch.zeros(120)))
    axis = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    turned = quaternion_from_rotation_vector(turn[:, None, None] * axis)
    ends = torch.tensor([[0.0, 0.0, 0.0], [0.55, 0.0, 0.0]])
    grips = Grip(ends.expand(240 + 60, 2, 3), turned, torch.ones(300, 2, dtype=torch.bool))
    left = {}
    values = {"bending_creep": {"rate": far}, "bending_plasticity": {"radius": far}}[id]
    for name, strength in (("with", values), ("without", {})):
        causes = [LIBRARY[id].extension(**strength), LIBRARY["drag_linear"].extension(coefficient=8.0)]
        sim = SpringMass(body, dataclasses.replace(PHYSICS, damping=1.0), NOWHERE, extensions=causes)
        begun = sim.start(holding(flat, {0: 0, 1: 0, 10: 1, 11: 1}), still(ends))
        left[name] = float(sim.rollout(begun, grips)[-1, :, 1].abs().max())
    assert left["without"] < 2e-4 and left["with"] > 5e-3


def test_gripper_offset_and_rotation_move_what_is_held() -> None:
    # A gripper turned by 90 degrees about z: its x axis is world y. Held at (0.05, 0, 0) from its origin.
    turn = quaternion_from_rotation_vector(torch.tensor([0.0, 0.0, math.pi / 2]))
    grip = Grip(torch.zeros(1, 3), turn.expand(1, 4), torch.ones(1, dtype=torch.bool))
    state = holding(state_of(line().rest_position), {1: 0})
    for id, values, expected in (
        ("gripper_offset", {"offset": (0.01, 0.02, 0.03)}, (0.05 - 0.02, 0.01, 0.03)),
        # 0.3 rad about the gripper's z axis, which is world z.
        ("gripper_rotation", {"rotation": (0.0, 0.0, 0.3)}, (0.05 * math.cos(0.3), 0.05 * math.sin(0.3), 0.0)),
        # 0.3 rad about its x axis, world y: down.
        ("gripper_rotation", {"rotation": (0.3, 0.0, 0.0)}, (0.05 * math.cos(0.3), 0.0, -0.05 * math.sin(0.3))),
    ):
        sim = SpringMass(line(), PHYSICS, extensions=[LIBRARY[id].extension(**values)])
        x = sim.rollout(sim.start(state, grip), Grip(*(v[None] for v in vars(grip).values())))
        assert x[0, 1].tolist() == pytest.approx(expected, abs=1e-6)


def hanging(weakness: float, damping: float, periods: int) -> Tensor:
    """Height (T,) [m] of the first held particle of a line of 0.06 kg that hangs from two."""
    body = line(length=0.55)
    down = np.zeros((12, 3))
    down[:, 2] = -np.linspace(0.0, 0.55, 12)
    slip = LIBRARY["grip_slip"].extension(weakness=weakness, damping=damping)
    sim = SpringMass(body, PHYSICS, extensions=[slip])
    up = still(torch.zeros(1, 3))
    begun = sim.start(holding(state_of(down), {0: 0, 1: 0}), up)
    return sim.rollout(begun, still(torch.zeros(1, 3), periods))[:, 0, 2]


def test_grip_slips_when_the_pull_exceeds_its_limit() -> None:
    # The line weighs 0.06 kg 9.81 m/s^2 = 0.589 N; springs that take up the weight at first add at most as much.
    assert torch.equal(hanging(1.0 / 1.2, 5.0, 100), torch.zeros(100))
    # Held with 0.4 N and 5 N s/m: beyond the first swings it slides steadily at (0.589 - 0.4)/5 = 37.7 mm/s.
    fall = hanging(1.0 / 0.4, 5.0, 200)
    assert float(fall[100] - fall[199]) == pytest.approx(0.0377 * 0.99, rel=0.01)
    # A grip without friction or damping does not hold: after the springs have swung, the line falls freely.
    free = hanging(50.0, 0.0, 40)
    assert float(free[-1]) == pytest.approx(-0.5 * 9.81 * 0.4**2, rel=0.05)


def recover(
    simulate: Callable[[list[Extension]], Tensor], id: str, name: str, truth: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Gauss-Newton on trajectories, derivatives by differences; all steps of one round run as worlds of one call."""
    effect = LIBRARY[id]
    fixed = {k: v for k, v in ALL[id].items() if k != name}

    def at(values: np.ndarray) -> Extension:
        return effect.extension(**{name: tuple(values.tolist()), **fixed})

    size = len(truth)
    target = simulate([at(truth)] * (size + 1))[:, 0].flatten()
    best = start.astype(float)
    for _ in range(8):
        step = 0.02 * np.maximum(np.abs(best), 0.1 * np.abs(truth).max())
        worlds = simulate([at(best), *(at(best + step[k] * np.eye(size)[k]) for k in range(size))])
        base = worlds[:, 0].flatten()
        slope = torch.stack([(worlds[:, 1 + k].flatten() - base) / step[k] for k in range(size)], dim=1)
        best = best + torch.linalg.lstsq(slope.double(), (target - base).double()[:, None]).solution[:, 0].numpy()
    return best


@pytest.mark.parametrize("id", list(ALL))
def test_planted_value_is_found(id: str) -> None:
    name, planted = next(iter(ALL[id].items()))
    truth = np.atleast_1d(np.asarray(planted, dtype=float))
    size = len(truth)
    state, first, grips = swing(1, 40)

    def simulate(extensions: list[Extension]) -> Tensor:
        worlds = len(extensions)
        sim = SpringMass(line(), [PHYSICS] * worlds, extensions=[[e] for e in extensions], substeps=30)
        begun = at_time(sim.start(*_repeated(state, first, worlds)), 100.0)
        return sim.rollout(begun, Grip(*(v.expand(-1, worlds, *v.shape[2:]) for v in vars(grips).values())))

    found = recover(simulate, id, name, truth, 0.7 * truth)
    assert float(np.abs(found - truth).max()) < 0.02 * float(np.abs(truth).max()), (found, truth, size)


def _repeated(state: State, first: Grip, worlds: int) -> tuple[State, Grip]:
    position, velocity, held = (
        v.expand(worlds, *v.shape[1:]).contiguous() for v in (state.position, state.velocity, state.held)
    )
    return State(position, velocity, held), Grip(*(v.expand(worlds, *v.shape[1:]) for v in vars(first).values()))


@pytest.mark.parametrize(("degrees", "refused"), [(0.0, True), (3.0, True), (8.0, False), (90.0, False)])
def test_a_gripper_whose_y_axis_lies_along_the_line_gives_its_bends_no_frame(degrees: float, refused: bool) -> None:
    body = line()
    along = torch.as_tensor(body.rest_position[1] - body.rest_position[0], dtype=torch.float32)
    along = along / along.norm()
    y = torch.tensor([0.0, 1.0, 0.0])
    axis = torch.linalg.cross(y, along)  # turns y towards the line
    turn = axis / axis.norm() * (math.acos(float(y @ along)) - math.radians(degrees))
    grip = Grip(torch.zeros(1, 3), quaternion_from_rotation_vector(turn)[None], torch.ones(1, dtype=torch.bool))
    state = holding(state_of(body.rest_position), {0: 0, 1: 0})
    damped = [LIBRARY["bending_damping"].extension(time=0.05)]
    SpringMass(body, PHYSICS, Scene(), extensions=()).start(state, grip)  # nothing needs the frame
    simulator = SpringMass(body, PHYSICS, Scene(), extensions=damped)
    if refused:
        with pytest.raises(InputError, match=f"y axis along it.*{degrees:.1f} degrees"):
            simulator.start(state, grip)
    else:
        simulator.start(state, grip)

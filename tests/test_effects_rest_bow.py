"""A line that came off a spool turns about its own axis until its arc lies as the line is bent: laws of that turn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from springmass_cases import holding, line, state_of, still
from torch import Tensor

from pred_core.effects import LIBRARY
from pred_core.effects.rest_bow import TORSION
from pred_core.springmass import SpringMass
from pred_core.types import Body, Physics, Scene, State

PHYSICS = Physics(stiffness=60.0, damping=1.0, bending_stiffness=1e-3)
SCENE = Scene(gravity=(0.0, 0.0, -1.0))
KAPPA = (3.0, 5.0)  # [1/m]
ENDS = {"first": {0: 0, 1: 0}, "last": {11: 0, 10: 0}, "both": {0: 0, 1: 0, 10: 1, 11: 1}}


def settled(body: Body, held: dict[int, int], curvature: tuple[float, float]) -> tuple[State, Tensor]:
    """After 20 s in air that brakes: the state, and the memory of laws and frames."""
    where = [0, -1] if len(held) > 2 else [-1 if min(held) else 0]
    ends = torch.as_tensor(body.rest_position[where])
    causes = [LIBRARY["rest_bow"].extension(curvature=curvature), LIBRARY["drag_linear"].extension(coefficient=2.0)]
    sim = SpringMass(body, PHYSICS, SCENE, extensions=causes)
    begun = sim.start(holding(state_of(body.rest_position), held), still(ends.float()))
    _, after = sim.rollout_states(begun, still(ends.float(), periods=2000))
    assert float(after.velocity.norm(dim=-1).max()) < 1e-3
    return after, after.memory["effects"].flatten().double()


def energy(twist: np.ndarray, start: float, curvature: np.ndarray, rest: np.ndarray) -> float:
    """Of bending and torsion over EI/l, of a line whose curvature components (B, 2) are given: theta counts from
    `start` at the first edge and grows by `twist` (B,) [rad] over each bend, which sees the mean of its two edges."""
    angle = start + np.cumsum(twist) - 0.5 * twist
    turned = np.stack([np.cos(angle) * rest[0] - np.sin(angle) * rest[1],
                       np.sin(angle) * rest[0] + np.cos(angle) * rest[1]], axis=1)  # fmt: skip
    return float(0.5 * ((curvature - turned) ** 2).sum() + 0.5 * TORSION * (twist**2).sum())


@pytest.mark.parametrize("ends", sorted(ENDS))
def test_the_turn_is_that_of_least_energy(ends: str) -> None:
    body = line()
    _, memory = settled(body, ENDS[ends], KAPPA)
    bends = len(body.bends)
    curvature = memory[4 : 4 + 2 * bends].reshape(bends, 2).numpy()
    twist = memory[4 + 2 * bends : 4 + 3 * bends].numpy()
    rest = np.array(KAPPA) * 0.55 / 11
    # In a gripper the material does not turn: at its first edge, at its last, or at both.
    def cost(t: np.ndarray) -> float:
        held = t - t.mean() if ends == "both" else t
        return energy(held, -held.sum() if ends == "last" else 0.0, curvature, rest)

    least = minimize(cost, np.zeros(bends), tol=1e-12).x
    least = least - least.mean() if ends == "both" else least
    assert np.abs(least).sum() > 0.1, "it turns"
    assert twist == pytest.approx(least, abs=2e-3)


def test_a_line_and_its_mirror_image_settle_alike() -> None:
    """Mirrored in x = 0 and counted from its other end a line has the same tangents, and so the same components: a
    curvature is an axial vector, which a mirror turns round, and so does counting from the other end."""
    body = line()
    way = np.array([-1.0, 1.0, 1.0])
    mirrored = dataclasses.replace(body, rest_position=(body.rest_position * way)[::-1].copy())
    one, _ = settled(body, ENDS["first"], KAPPA)
    other, _ = settled(mirrored, ENDS["last"], KAPPA)
    image = (other.position * torch.as_tensor(way, dtype=torch.float32)).flip(-2)
    assert float((one.position - image).abs().max()) < 1e-3


def test_a_line_without_rest_curvature_does_not_turn() -> None:
    body = line()
    _, memory = settled(body, ENDS["first"], (0.0, 0.0))
    assert float(memory[4 + 2 * len(body.bends) :].abs().max()) == 0.0

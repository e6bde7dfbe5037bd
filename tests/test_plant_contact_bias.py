"""Friction in the plant acts against the sliding, also where the rope's joints turn fast."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from plant_cases import plan

from pred_core.plant import world as plant_world
from pred_core.plant.rope import RopeConfig, build_rope
from pred_core.plant.world import World, run_episode
from pred_core.types import STANDARD_GRAVITY

OWN = -RopeConfig().mass / RopeConfig().links * STANDARD_GRAVITY[2]  # [N] weight of a link


class Watched(World):
    """Keeps how the rope's contacts slide [m/s], what pushes them [N] and what was taken off their references."""

    def __init__(self) -> None:
        super().__init__(build_rope(RopeConfig()))
        self.rows: list[np.ndarray] = []

    def finish_step(self, drive, index, drag) -> None:
        """One row a contact, after the rope was laid."""
        before = self.data.efc_aref.copy()
        address = np.array([c.efc_address for c in self.data.contact], dtype=int)
        rate = [_rate(self, n) for n in range(self.data.ncon)]
        velocity = self.data.efc_vel.copy()
        super().finish_step(drive, index, drag)
        if self.time >= 0.0:
            force = np.zeros(6)
            for n, row in enumerate(address):
                mujoco.mj_contactForce(self.model, self.data, n, force)
                taken = before[row : row + 3] - self.data.efc_aref[row : row + 3]
                self.rows.append(np.concatenate([velocity[row + 1 : row + 3], force[:3], taken, rate[n]]))


def _rate(world: World, n: int) -> np.ndarray:
    """dJ/dt v (3,) [m/s^2] of a contact of the rope with the table, in the contact's frame, by MuJoCo's Jacobian."""
    contact, model, data = world.data.contact[n], world.model, world.data
    rate, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    side = 0 if contact.geom[1] == world.ground else 1
    mujoco.mj_jacDot(model, data, rate, turn, contact.pos, model.geom_bodyid[contact.geom[side]])
    return (2 * side - 1) * contact.frame.reshape(3, 3) @ (rate @ data.qvel)


def slide() -> np.ndarray:
    """(N, 11) rows of an episode of 2 s on the table."""
    world = Watched()
    run_episode(world, plan("table", "usual").motion, 2.0, 30)
    return np.array(world.rows)


def against(rows: np.ndarray) -> float:
    """Mean cosine between friction and the opposite of the sliding, of contacts that slide and carry about a weight."""
    velocity, force = rows[:, :2], rows[:, 2:5]
    chosen = (np.linalg.norm(velocity, axis=1) > 0.03) & (force[:, 0] > 0.2 * OWN) & (force[:, 0] < 3.0 * OWN)
    velocity, friction = velocity[chosen], force[chosen, 1:]
    assert len(velocity) > 100
    size = np.linalg.norm(velocity, axis=1) * np.linalg.norm(friction, axis=1)
    return float((-(velocity * friction).sum(axis=1) / size).mean())


def test_friction_opposes_the_sliding_and_not_without_the_jacobians_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = slide()
    taken, rate = rows[:, 5:8], rows[:, 8:]
    assert np.abs(rate[:, 1:]).max() > 5.0  # [m/s^2] as much as 1.6 cm/s of sliding counts for; 19 measured
    assert np.allclose(taken, rate, atol=1e-9)
    assert against(rows) > 0.97  # 0.995 measured
    monkeypatch.setattr(plant_world, "add_contact_bias", lambda model, data: None)
    assert against(slide()) < 0.6  # 0.515 measured

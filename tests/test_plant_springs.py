"""The second world obeys the laws of springs, contact and friction, in numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plant_cases import CLEAN, hurry, plan, still

from pred_core.bag.dataset import load_dataset
from pred_core.cli.main import main
from pred_core.plant.drive import poses
from pred_core.plant.session import SessionConfig
from pred_core.plant.springs import Line, SpringsConfig, draw_springs, simulate_springs, write_springs_case
from pred_core.springmass import SpringMass, build_body
from pred_core.types import Grip, Physics, Scene, State

NOWHERE = np.zeros((1, 2, 3))


def test_a_hanging_line_stretches_by_its_weight() -> None:
    """Springs of k = 100 N per strain, one neighbour each: spring j carries the particles below it."""
    springs = SpringsConfig(stiffness=100.0, damping=0.05, reach=1)
    record = simulate_springs([still()], springs, 0.05, 30)[0]
    length = np.linalg.norm(np.diff(record.position[-1], axis=0), axis=-1)[1:]
    below = (np.arange(28, 0, -1) - 0.5) * 0.05 / 29 * 9.81  # the particles at the ends weigh half
    assert length == pytest.approx(0.7 / 29 * (1.0 + below / 100.0), rel=1e-5)


def test_inner_forces_have_no_sum_and_no_moment() -> None:
    generator = np.random.default_rng(0)
    x, v = generator.normal(0.0, 0.1, (2, 10, 3)), generator.normal(0.0, 1.0, (2, 10, 3))
    force = Line(SpringsConfig(reach=3), 10).force(x, v)
    scale = np.abs(force).max()
    assert np.abs(force.sum(axis=1)).max() < 1e-12 * scale
    assert np.abs(np.cross(x, force).sum(axis=1)).max() < 1e-12 * scale


def test_a_spring_pulls_with_its_strain_and_damps_its_rate() -> None:
    """Two particles 0.5 m apart at rest, 0.6 m apart now and parting at 2 m/s: 10 N/1 * 0.2 + 0.1 * 2 = 2.2 N."""
    line = Line(SpringsConfig(stiffness=10.0, damping=0.1, reach=1, length=0.5), 2)
    x = np.array([[[0.0, 0.0, 1.0], [0.6, 0.0, 1.0]]])
    v = np.array([[[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]]])
    assert line.force(x, v)[0] == pytest.approx(np.array([[2.2, 0.0, 0.0], [-2.2, 0.0, 0.0]]))


def test_sliding_stops_by_coulomb_friction() -> None:
    """On the ground at 1 m/s with mu = 0.4: after 0.1 s, 1 - 0.4 * 9.81 * 0.1 = 0.6076 m/s; it stays on the ground."""
    line = Line(SpringsConfig(stiffness=1.0, damping=0.0, friction=0.4, reach=1), 6)
    x = np.zeros((1, 6, 3))
    x[0, :, 0] = line.spacing * np.arange(6)
    v = np.zeros_like(x)
    v[..., 0] = 1.0
    h = 1e-4
    for step in range(1, 1001):
        # The first two are led along with the others, so that no spring is strained.
        moved = 1.0 * step * h - 0.5 * 0.4 * 9.81 * (step * h) ** 2
        held = np.stack([[moved + line.spacing * i, 0.0, 0.0] for i in range(2)])[None]
        x, v = line.step(x, v, held, 0.0, h)
    assert v[0, 2:, 0] == pytest.approx(0.6076, abs=1e-3)
    assert np.abs(x[..., 2]).max() < 1e-12


def test_a_falling_line_lands_and_does_not_sink() -> None:
    line = Line(SpringsConfig(reach=1), 5)
    x = np.zeros((1, 5, 3))
    x[0, :, 0], x[..., 2] = line.spacing * np.arange(5), 0.05
    v = np.zeros_like(x)
    lowest = 1.0
    for _ in range(3000):
        x, v = line.step(x, v, x[:, :2].copy(), 0.0, 1e-4)
        lowest = min(lowest, float(x[..., 2].min()))
    assert lowest > -1e-12 and x[0, 3:, 2] == pytest.approx(0.0, abs=2e-3)


def test_twice_the_steps_give_nearly_the_same_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """First-order steps: halving them halves an error below the tracks' noise; folds on the ground amplify it."""
    hurry(monkeypatch)
    motions = [plan("air").motion, plan("table").motion]
    springs = SpringsConfig(stiffness=80.0, damping=0.02, reach=2)
    fine = SpringsConfig(stiffness=80.0, damping=0.02, reach=2, substeps=80)
    both = [simulate_springs(motions, s, 0.3, 30) for s in (springs, fine)]
    for a, b, tolerance in zip(*both, (2e-4, 7e-4), strict=True):
        assert np.linalg.norm(a.position - b.position, axis=-1).mean() < tolerance


@pytest.mark.parametrize(("regime", "tolerance"), [("air", 7e-4), ("table", 7e-4)])
def test_our_simulator_can_be_right_about_it(regime: str, tolerance: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the true parameters and start, our float32 simulator, with fewer steps, stays within the tracks' noise
    (0.76 mm) over half a second of motion. So "nothing is hidden" can be true here.
    """
    hurry(monkeypatch)
    springs = SpringsConfig(stiffness=60.0, damping=0.03, friction=0.5, reach=2)
    motion = plan(regime, seconds=1.2).motion
    record = simulate_springs([motion], springs, 1.15, 30)[0]
    physics = Physics(
        stiffness=60.0, damping=0.03, connection_threshold=2.5 * 0.7 / 29, max_springs=4, ground_friction=0.5
    )
    rest = np.zeros((30, 3))
    rest[:, 0] = np.linspace(0.0, 0.7, 30)
    simulator = SpringMass(build_body("line", rest, 0.05, physics), physics, Scene(ground=0.0), period=1 / 30)
    assert simulator.substeps < 400  # the springs' world takes 40 steps of 1/300 s
    frames = 0.6 + np.arange(16) / 30
    position = record.position_at(frames)
    before = record.position_at(frames[:1] - 1 / 300)
    place, rotation = poses(record.gripper_at(frames))
    grips = Grip(
        torch.as_tensor(place[:, None], dtype=torch.float32),
        torch.as_tensor(rotation[:, None], dtype=torch.float32),
        torch.ones(16, 1, dtype=torch.bool),
    )
    held = torch.full((30,), -1, dtype=torch.int32)
    held[:2] = 0
    state = State(
        torch.as_tensor(position[0], dtype=torch.float32),
        torch.as_tensor((position[0] - before[0]) * 300.0, dtype=torch.float32),
        held,
    )
    state = simulator.start(state, grips.at(0))
    for t in range(15):
        state = simulator.step(state, grips.at(t + 1))
    error = np.linalg.norm(state.position.numpy() - position[15], axis=-1).mean()
    assert np.linalg.norm(position[15] - position[0], axis=-1).mean() > 0.01 and error < tolerance


def test_a_spring_case_by_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)
    root = tmp_path / "springs"
    command = ["plant", "springs", "--seed", "4", "--out", str(root), "--episodes", "2", "1", "3", "--seconds", "0.2"]
    assert main(command) == 0 and main(["info", str(root)]) == 0
    episodes = list(load_dataset(root).episodes())
    assert {tuple(np.flatnonzero(e.held == 0)) for e in episodes} == {(0, 1), (28, 29)}
    (root / "ep001.mcap").unlink()
    assert main(command) == 0
    again = list(load_dataset(root).episodes())[1]
    assert np.array_equal(again.position, episodes[1].position, equal_nan=True)
    assert draw_springs(4) == draw_springs(4) != draw_springs(5)


def test_a_faultless_tracker_reports_the_particles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)
    session = SessionConfig(train=1, test=0, ood=0, seconds=0.2)
    shown: list[str] = []
    dataset = write_springs_case(
        tmp_path / "s", 4, lambda done, total, name: shown.append(name), session=session, sensor=CLEAN
    )
    episode = next(dataset.episodes())
    length = np.linalg.norm(np.diff(episode.position, axis=1), axis=-1)
    assert shown == ["ep000"] and len(episode.stamps) == 6
    assert length[:, 0] == pytest.approx(0.7 / 29, rel=1e-5) and np.abs(length / (0.7 / 29) - 1.0).max() < 0.05

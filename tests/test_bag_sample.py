"""The synthetic sample: it is small, it is there, and its generator obeys mechanics."""

from pathlib import Path

import numpy as np
import pytest

from pred_core.bag import sample
from pred_core.bag.dataset import load_dataset
from pred_core.bag.gate import examine_all
from pred_core.bag.sample import HELD, SampleCable, make_episodes

BUNDLED = Path(__file__).resolve().parents[1] / "bags" / "sample_cable"


def _quiet(done: int, total: int, name: str) -> None:
    pass


def test_the_bundled_sample() -> None:
    assert sum(f.stat().st_size for f in BUNDLED.rglob("*")) < 1_500_000
    dataset = load_dataset(BUNDLED)
    assert [e.split for e in dataset.entries] == ["train"] * 4 + ["test"] * 2
    episodes = list(dataset.episodes())
    assert {e.position.shape for e in episodes} == {(300, 12, 3)}
    assert [q.flags for q in examine_all(lambda: iter(episodes))] == [()] * 6
    for episode in episodes:
        # The first and last node sit at the gripper's origin; 0.1 mm noise, 600 coordinates x 3: 5 sigma.
        for particle, gripper in ((0, 0), (11, 1)):
            off = episode.position[:, particle] - episode.grips.position[:, gripper].numpy()
            assert np.abs(off).max() < 5.5e-4
            assert off.std() == pytest.approx(1e-4, rel=0.15)
    moving = episodes[0].grips.position[:, 0].numpy()
    assert np.ptp(moving, axis=0).max() > 0.05


def test_the_same_seed_makes_the_same_episodes() -> None:
    small = SampleCable(seconds=0.05, settle=0.02, splits=("train",))
    a, b = (make_episodes(small, np.random.default_rng(3), _quiet)[0] for _ in range(2))
    assert np.array_equal(a.position, b.position) and a.held.tolist() == [0, 0] + [-1] * 8 + [1, 1]
    assert set(HELD) == {0, 1, 10, 11}


def test_forces_are_minus_the_gradient_of_the_energy() -> None:
    """Axial and bending energy by central differences (error of order 1e-6 of the force at a step of 1e-6 m)."""
    cable = SampleCable(nodes=6, length=0.15)
    spacing = 0.03

    def energy(p: np.ndarray) -> float:
        edge = np.diff(p, axis=0)
        length = np.linalg.norm(edge, axis=-1)
        unit = edge / length[:, None]
        angle = np.arccos(np.sum(unit[:-1] * unit[1:], axis=-1))
        axial = 0.5 * cable.axial * spacing * np.sum((length / spacing - 1.0) ** 2)
        rest = cable.rest_curvature * spacing
        return float(axial + 0.5 * cable.bending / spacing * np.sum((angle - rest) ** 2))

    generator = np.random.default_rng(0)
    p = np.cumsum(generator.normal([0.03, 0.0, 0.0], 0.006, (6, 3)), axis=0)
    force = sample._force(cable, p[None], np.zeros((1, 6, 3)), spacing)[0]
    step = 1e-6
    for i in range(6):
        for axis in range(3):
            ahead, behind = p.copy(), p.copy()
            ahead[i, axis] += step
            behind[i, axis] -= step
            slope = (energy(ahead) - energy(behind)) / (2 * step)
            assert force[i, axis] == pytest.approx(-slope, rel=1e-4, abs=1e-4)
    assert np.abs(force.sum(axis=0)).max() < 1e-9  # internal forces cancel


def test_the_cable_at_rest_pulls_with_half_its_weight_at_each_end() -> None:
    """Vertical balance: the two clamps carry mass x g; by symmetry the two lowest nodes stay level."""
    cable = SampleCable(seconds=0.02, settle=2.0, noise=0.0, splits=("train",))
    episode = make_episodes(cable, np.random.default_rng(1), _quiet)[0]
    z = episode.position[0, :, 2]
    assert z[:6] == pytest.approx(z[:5:-1], abs=2e-3)  # symmetric shape
    assert z.min() < 0.6  # it hangs
    lengths = np.linalg.norm(np.diff(episode.position[0], axis=0), axis=-1)
    # 0.25 N of half the weight stretches 300 N per strain by less than 0.2 %; chords of a bent cable are shorter.
    assert lengths.max() < 0.09 * 1.002

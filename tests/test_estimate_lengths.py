"""A correction of tracks keeps the lengths of springs, whatever net they make."""

from __future__ import annotations

import numpy as np
import pytest

from pred_core.estimate.lengths import Lengths
from pred_core.springmass.topology import build_body
from pred_core.types import Body, Physics


def test_a_line_whose_springs_reach_far_may_be_bent_by_tracks() -> None:
    """Springs over several particles stand for bending. A full turn of a circle has a straight line's neighbour
    lengths, but chords over 4 edges that are sin(2 a) / (4 sin(a / 2)) = 0.933 times as long (a: 360 degrees / 19)."""
    x = np.zeros((20, 3))
    x[:, 0] = 0.025 * np.arange(20)
    physics = Physics(stiffness=30.0, damping=0.01, connection_threshold=0.11, max_springs=8)
    body = build_body("line", x, 0.05, physics)
    assert np.ptp(body.springs, axis=1).max() == 4
    turn = np.deg2rad(360.0) / 19 * (np.arange(19) + 0.5)
    arc = np.zeros((20, 3))
    arc[1:, :2] = 0.025 * np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)
    chords = np.linalg.norm(arc[4:] - arc[:-4], axis=1) / 0.1
    assert chords == pytest.approx(0.933, abs=0.001)
    lengths = Lengths(body, np.ones(20))
    assert np.allclose(lengths.keep(x, arc), arc, atol=1e-9)
    stretched = lengths.keep(x, 1.05 * arc)
    assert np.linalg.norm(np.diff(stretched, axis=0), axis=1) == pytest.approx(0.025, rel=1e-3)


def net(kind: str, side: int, reach: float, most: int) -> Body:
    """A square net or a cube of particles, 3 cm apart."""
    axes = np.meshgrid(*[np.arange(side)] * (3 if kind == "volume" else 2), indexing="ij")
    rest = np.zeros((axes[0].size, 3))
    rest[:, : len(axes)] = 0.03 * np.stack([a.ravel() for a in axes], axis=1)
    physics = Physics(stiffness=100.0, damping=0.05, connection_threshold=reach, max_springs=most)
    return build_body(kind, rest, 0.05, physics, id=np.arange(len(rest), dtype=np.uint32))


@pytest.mark.parametrize(
    ("kind", "side", "reach", "most"),
    [("sheet", 4, 0.043, 8), ("sheet", 12, 0.043, 8), ("sheet", 24, 0.065, 24), ("volume", 6, 0.053, 24)],
)
def test_lengths_of_sheets_and_volumes_are_kept_too(kind: str, side: int, reach: float, most: int) -> None:
    """Nets with diagonals, from 12 x 12 on more springs than are solved for at once: 3 mm of noise on 3 cm is 10 % of
    strain, less than 1 % is left, what is held has not moved, and no spring is driven apart any more."""
    body = net(kind, side, reach, most)
    rest = body.rest_position
    free = np.ones(body.count)
    free[:side] = 0.0
    i, j = body.springs.T
    bent = rest + 0.02 * np.sin(8.0 * rest[:, 1:2]) * [0.0, 0.0, 1.0]
    noise = np.random.default_rng(2).normal(0.0, 0.003, bent.shape) * free[:, None]
    lengths = Lengths(body, free)
    kept = lengths.keep(bent, bent + noise)

    def strain(place: np.ndarray) -> float:
        length = np.linalg.norm(bent[j] - bent[i], axis=1)
        return float(np.sqrt(np.mean((np.linalg.norm(place[j] - place[i], axis=1) / length - 1.0) ** 2)))

    assert strain(bent + noise) > 0.08 and strain(kept) < 0.01
    assert np.array_equal(kept[:side], bent[:side])
    along = (kept[j] - kept[i]) / np.linalg.norm(kept[j] - kept[i], axis=1)[:, None]
    parting = [np.linalg.norm(((v[j] - v[i]) * along).sum(axis=1)) for v in (noise, lengths.still(kept, noise))]
    assert parting[1] < 0.05 * parting[0]


@pytest.mark.parametrize("sweeps", [1, 3, 10])
def test_a_net_that_is_solved_for_in_part_is_stretched_less_than_before(
    sweeps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cube: with every sweep less is left, in lengths and in speeds; it never ends worse than it came."""
    monkeypatch.setattr("pred_core.estimate.lengths.SWEEPS", sweeps)
    body = net("volume", 5, 0.053, 24)
    i, j = body.springs.T
    moved = body.rest_position + np.random.default_rng(4).normal(0.0, 0.006, (body.count, 3))
    lengths = Lengths(body, np.ones(body.count))
    growth = [
        np.linalg.norm(np.linalg.norm(x[j] - x[i], axis=1) - body.rest_length)
        for x in (moved, lengths.keep(body.rest_position, moved))
    ]
    assert growth[1] < 0.8 * growth[0]

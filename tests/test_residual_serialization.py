"""Space-filling curves: what makes them useful, and cells worked out by hand."""

from __future__ import annotations

import pytest
import torch

from pred_core.residual.serialization import hilbert_code, quantize, serial_orders, z_code


def all_cells(bits: int) -> torch.Tensor:
    size = 1 << bits
    flat = torch.arange(size**3)
    return torch.stack((flat // size**2, flat // size % size, flat % size), -1)


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_hilbert_visits_every_cell_once_and_never_jumps(bits: int) -> None:
    cells = all_cells(bits)
    code = hilbert_code(cells, bits)
    assert code.sort().values.equal(torch.arange(len(cells)))
    walk = cells[code.argsort()]
    assert (walk[1:] - walk[:-1]).abs().sum(-1).eq(1).all()  # each next cell shares a face


def test_z_code_interleaves_bits() -> None:
    # x = 10b, y = 01b, z = 11b -> bits (x1 y1 z1)(x0 y0 z0) = 101 011b = 43
    assert int(z_code(torch.tensor([2, 1, 3]), bits=2)) == 43
    assert z_code(all_cells(3), 3).unique().numel() == 512


def test_quantize_fills_the_bounding_cube_of_each_cloud() -> None:
    cloud = torch.tensor([[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]])
    cells = quantize(torch.stack((cloud, 5.0 + 0.01 * cloud)), bits=3)
    assert cells[0].tolist() == [[0, 0, 0], [7, 4, 0]]  # half of the longest side is cell 4 of 8
    assert cells[1].tolist() == cells[0].tolist()  # neither place nor size matters
    assert quantize(torch.zeros(4, 3)).eq(0).all()  # a cloud of one point has no extent


def test_orders_are_permutations_and_batch_equals_loop() -> None:
    clouds = torch.rand(3, 50, 3, generator=torch.Generator().manual_seed(0))
    orders = serial_orders(clouds)
    assert orders.shape == (4, 3, 50)
    assert orders.sort(-1).values.equal(torch.arange(50).expand(4, 3, 50))
    for b in range(3):
        assert serial_orders(clouds[b : b + 1])[:, 0].equal(orders[:, b])


def test_transposed_orders_are_those_of_the_cloud_with_x_and_y_exchanged() -> None:
    cloud = torch.rand(1, 200, 3, generator=torch.Generator().manual_seed(1))
    orders, exchanged = serial_orders(cloud), serial_orders(cloud[..., [1, 0, 2]])
    assert exchanged[0].equal(orders[1]) and exchanged[2].equal(orders[3])
    assert not exchanged[0].equal(orders[0])


def test_neighbours_along_the_curves_are_neighbours_in_space() -> None:
    cloud = torch.rand(1, 1000, 3, generator=torch.Generator().manual_seed(2))
    random_step = (cloud[0, 1:] - cloud[0, :-1]).norm(dim=-1).mean()  # 0.66 for a unit cube
    for order in serial_orders(cloud)[:, 0]:
        step = cloud[0, order].diff(dim=0).norm(dim=-1).mean()
        assert step < 0.25 * random_step  # 1000 points have a spacing of 0.1, a sixth of that

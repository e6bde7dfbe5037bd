"""Space-filling-curve orders of a point cloud: z-order, Hilbert, and both with x and y exchanged.

PTv3 (paper III-C) attends inside patches of points that are neighbours along such a curve, so that no
neighbour search is needed. Codes are read from a table over all cells of the grid, computed once per
device: at 6 bits an axis the table has 2^18 entries and one look-up replaces about 60 bit operations.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

ORDERS = ("z", "z_transposed", "hilbert", "hilbert_transposed")
BITS = 6  # cells per axis = 64: finer than a patch of any cloud of some thousand points


def quantize(position: Tensor, bits: int = BITS) -> Tensor:
    """Cells (..., N, 3) int64 in 0..2^bits-1 on the cloud's own bounding cube; position (..., N, 3) [m]."""
    low = position.amin(dim=-2, keepdim=True)
    extent = (position.amax(dim=-2, keepdim=True) - low).amax(dim=-1, keepdim=True)
    size = 1 << bits
    scaled = (position - low) * (size / extent.clamp_min(torch.finfo(position.dtype).tiny * size))
    return scaled.long().clamp(0, size - 1)


def z_code(cells: Tensor, bits: int = BITS) -> Tensor:
    """Morton code (...) int64: the bits of x, y, z interleaved, x highest; cells (..., 3)."""
    x, y, z = cells.unbind(-1)
    code = torch.zeros_like(x)
    for b in range(bits):
        code |= (((x >> b) & 1) << (3 * b + 2)) | (((y >> b) & 1) << (3 * b + 1)) | (((z >> b) & 1) << (3 * b))
    return code


def hilbert_code(cells: Tensor, bits: int = BITS) -> Tensor:
    """Hilbert code (...) int64; cells with consecutive codes share a face; cells (..., 3).

    J. Skilling, Programming the Hilbert curve (2004): undo the excess rotations, then Gray-encode.
    """
    axes = list(cells.unbind(-1))
    q = 1 << (bits - 1)
    while q > 1:
        mask = q - 1
        for i in range(3):
            inverted = (axes[i] & q) != 0
            exchanged = torch.where(inverted, 0, (axes[0] ^ axes[i]) & mask)
            first = axes[0] ^ torch.where(inverted, mask, exchanged)
            axes[i] = axes[i] ^ exchanged
            axes[0] = first
        q >>= 1
    axes[1] = axes[1] ^ axes[0]
    axes[2] = axes[2] ^ axes[1]
    flip = torch.zeros_like(axes[0])
    q = 1 << (bits - 1)
    while q > 1:
        flip = torch.where((axes[2] & q) != 0, flip ^ (q - 1), flip)
        q >>= 1
    return z_code(torch.stack([a ^ flip for a in axes], dim=-1), bits)


@cache
def _tables(device: torch.device) -> Tensor:
    """(2, 2^(3 BITS)) int32: z and Hilbert code of the cell with flat index x*4^BITS + y*2^BITS + z."""
    size = 1 << BITS
    flat = torch.arange(size**3)
    cells = torch.stack((flat // size**2, flat // size % size, flat % size), dim=-1)
    return torch.stack((z_code(cells), hilbert_code(cells))).int().to(device)


def serial_orders(position: Tensor) -> Tensor:
    """Point indices along each curve of ORDERS: (4, B, N) int64; position (B, N, 3) [m].

    Points in one cell keep their index order, so the result is deterministic.
    """
    x, y, z = quantize(position).unbind(-1)
    plain = (x << (2 * BITS)) | (y << BITS) | z
    transposed = (y << (2 * BITS)) | (x << BITS) | z
    codes = _tables(position.device)[:, torch.stack((plain, transposed))]  # (2 curves, 2 layouts, B, N)
    return codes.flatten(0, 1).argsort(dim=-1, stable=True)

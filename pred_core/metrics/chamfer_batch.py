"""Two-sided chamfer distance of many pairs at once, for planner costs: brute force in SIMD lanes, exact.

One pass over all point pairs keeps both minima (of rows and of columns), so neither side is forgotten.
On CPU a Warp kernel does it, on CUDA blocks of `torch.cdist`; `chamfer_two_sided` is the plain twin of both.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from pred_core.errors import InputError

_LANES = 16  # floats in a 64-byte vector
_FAR = 1e18  # [m] coordinate of padding points: their squared distance stays finite in float32

# Squared distances from 4 points of a to 16 points of b at a time; `column` keeps min over a for every b.
_CPU_SNIPPET = """
#if defined(__CUDA_ARCH__)
    return;
#else
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    const float* ax = a_soa.data + (long)pair * 3 * rows;
    const float* bx = b_soa.data + (long)b_pair * 3 * columns;
    const float *ay = ax + rows, *az = ay + rows, *by = bx + columns, *bz = by + columns;
    float* column = column_out.data + (long)pair * columns;
    float* row = row_out.data + (long)pair * rows;
    for (int j = 0; j < columns; ++j) column[j] = 3.0e38f;
    for (int i = 0; i < rows; i += 4) {
        lanes x[4], y[4], z[4], least[4];
        for (int k = 0; k < 4; ++k) {
            x[k] = ax[i + k] - lanes{};
            y[k] = ay[i + k] - lanes{};
            z[k] = az[i + k] - lanes{};
            least[k] = 3.0e38f - lanes{};
        }
        for (int j = 0; j < columns; j += 16) {
            const lanes qx = *(const lanes*)(bx + j), qy = *(const lanes*)(by + j), qz = *(const lanes*)(bz + j);
            lanes best = *(lanes*)(column + j);
            for (int k = 0; k < 4; ++k) {
                const lanes dx = x[k] - qx, dy = y[k] - qy, dz = z[k] - qz;
                const lanes d = dx * dx + dy * dy + dz * dz;
                least[k] = d < least[k] ? d : least[k];
                best = d < best ? d : best;
            }
            *(lanes*)(column + j) = best;
        }
        for (int k = 0; k < 4; ++k) {
            float least_one = least[k][0];
            for (int l = 1; l < 16; ++l) least_one = least[k][l] < least_one ? least[k][l] : least_one;
            row[i + k] = least_one;
        }
    }
#endif
"""


@wp.func_native(_CPU_SNIPPET)
def _nearest_squared_cpu(
    pair: int,
    b_pair: int,
    rows: int,
    columns: int,
    a_soa: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    b_soa: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    row_out: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    column_out: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
): ...


@wp.kernel(enable_backward=False)
def _pair_kernel(
    # body
    rows: int,
    columns: int,
    shared: int,
    # in
    a_soa: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    b_soa: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    # out
    row_out: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    column_out: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
):
    pair = wp.tid()
    b_pair = pair
    if shared == 1:
        b_pair = 0
    _nearest_squared_cpu(pair, b_pair, rows, columns, a_soa, b_soa, row_out, column_out)


def chamfer_two_sided_batch(a: Tensor, b: Tensor) -> Tensor:
    """`chamfer_two_sided_unsquared` of each pair, (B,) [m]. `a` (B, P, 3), `b` (B, Q, 3) or (1, Q, 3) [m] float32.

    On a CUDA device the pairs go through blocked `torch.cdist`; on CPU through the SIMD kernel.
    Raises: InputError for other shapes or non-finite points.
    """
    _check(a, b)
    if a.is_cuda:
        return by_distance_matrix(a, b)
    wp.init()
    batch, p, q = a.shape[0], a.shape[1], b.shape[1]
    a_soa, b_soa = _lanes_of(a, 4), _lanes_of(b, _LANES)
    rows, columns = a_soa.shape[2], b_soa.shape[2]
    row = a.new_empty(batch, rows)
    column = a.new_empty(batch, columns)
    wp.launch(
        _pair_kernel,
        dim=batch,
        inputs=[rows, columns, int(b.shape[0] == 1), wp.from_torch(a_soa.view(-1)), wp.from_torch(b_soa.view(-1))],
        outputs=[wp.from_torch(row.view(-1)), wp.from_torch(column.view(-1))],
        device="cpu",
    )
    return row[:, :p].sqrt().mean(dim=1) + column[:, :q].sqrt().mean(dim=1)


def by_distance_matrix(a: Tensor, b: Tensor) -> Tensor:
    """The same from whole distance matrices, 16 pairs at a time."""
    parts = []
    for pair in range(0, a.shape[0], 16):
        other = b if b.shape[0] == 1 else b[pair : pair + 16]
        block = a[pair : pair + 16]
        # Differences, not |a|^2 - 2ab + |b|^2: that loses near distances to rounding in float32.
        distance = torch.cdist(block, other, compute_mode="donot_use_mm_for_euclid_dist")
        parts.append(distance.amin(dim=2).mean(dim=1) + distance.amin(dim=1).mean(dim=1))
    return torch.cat(parts) if parts else a.new_empty(0)


def _lanes_of(points: Tensor, multiple: int) -> Tensor:
    """Coordinates first, (B, 3, M), padded to a multiple with points too far away to be nearest."""
    count = points.shape[1]
    padded = points.new_full((points.shape[0], 3, -(-count // multiple) * multiple), _FAR)
    padded[:, :, :count] = points.transpose(1, 2)
    return padded


def _check(a: Tensor, b: Tensor) -> None:
    for name, cloud in (("first", a), ("second", b)):
        if cloud.ndim != 3 or cloud.shape[2] != 3 or cloud.shape[1] == 0 or cloud.dtype != torch.float32:
            raise InputError(
                f"{name} clouds", got=f"{tuple(cloud.shape)} {cloud.dtype}", allowed="(B, P, 3) float32 with P > 0"
            )
        if not bool(torch.isfinite(cloud.sum())):  # NaN and infinity survive a sum; one pass, no temporary
            raise InputError(f"{name} clouds hold points that are not finite")
    if a.shape[0] != b.shape[0] and b.shape[0] != 1:
        raise InputError("batches differ in size", got=b.shape[0], allowed=f"{a.shape[0]} or 1")

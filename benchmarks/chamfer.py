"""Two-sided chamfer of 64 pairs of 1,000 points: SIMD brute force against a KD-tree, one thread, one process.

    python benchmarks/chamfer.py [--pairs 64] [--points 1000] [--rounds 15]

Rounds alternate the two; reported are minimum over minimum and the median paired ratio, after asserting
equal distances.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from scipy.spatial import cKDTree

from pred_core.metrics.chamfer_batch import chamfer_two_sided_batch
from pred_core.types import Array


def by_tree(a: Array, b: Array) -> Array:
    """(B,) two-sided unsquared, a tree for every cloud of every pair."""
    result = np.empty(len(a))
    for i, (x, y) in enumerate(zip(a, b, strict=True)):
        tree_x, tree_y = cKDTree(x), cKDTree(y)
        result[i] = tree_y.query(x)[0].mean() + tree_x.query(y)[0].mean()
    return result


def clouds(kind: str, pairs: int, points: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pairs (B, P, 3) [m]: a volume, or a sheet and its displaced copy (what a planner compares)."""
    a = rng.uniform(0.0, 0.5, (pairs, points, 3))
    if kind == "volume":
        return a, rng.uniform(0.0, 0.5, (pairs, points, 3))
    a[..., 2] = 0.05 * np.sin(8 * a[..., 0])
    return a, a + np.array([0.02, 0.0, 0.01]) + rng.normal(0, 0.002, a.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=15)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    for kind in ("volume", "sheet"):
        a, b = clouds(kind, args.pairs, args.points, rng)
        a32, b32 = torch.as_tensor(a, dtype=torch.float32), torch.as_tensor(b, dtype=torch.float32)
        np.testing.assert_allclose(chamfer_two_sided_batch(a32, b32).numpy(), by_tree(a, b), atol=1e-6)
        brute, tree = [], []
        for _ in range(args.rounds):
            begin = time.perf_counter()
            chamfer_two_sided_batch(a32, b32)
            middle = time.perf_counter()
            by_tree(a, b)
            brute.append(middle - begin)
            tree.append(time.perf_counter() - middle)
        paired = np.array(tree) / np.array(brute)
        print(
            f"{kind:7s} {args.pairs} pairs x {args.points} points: brute {1e3 * min(brute):.1f} ms, "
            f"KD-tree {1e3 * min(tree):.1f} ms, minimum ratio {min(tree) / min(brute):.1f}, "
            f"median paired ratio {np.median(paired):.1f}"
        )


if __name__ == "__main__":
    main()

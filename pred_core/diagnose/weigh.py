"""How much a residual counts: in units of what noise, chaos and the model's known misfit make of it.

A rollout amplifies what is not known of its start. Perturbed starts show where: there a residual says little about a
cause. Without this, the most chaotic moments would decide everything.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pred_core.diagnose.roll import Roller
from pred_core.identify.space import Candidate

DRAWS = 5  # perturbed starts
CHAOS = 1.5  # how much of their variance counts
START = 0.5  # standard deviation of a start's position over the track noise; of its velocity a frame, too
Weights = Tensor  # (W, K, N) [1/m]


def weigh(
    roller: Roller, candidate: Candidate, stride: int, misfit: Tensor | None, seed: int, chaos: bool = True
) -> Weights:
    """1 / standard deviation of a residual of this sample.

    `misfit` (K,) [m^2]: variance a frame of a window that the reference already has; absent: none is known. `chaos`:
    the spread of perturbed starts counts.
    """
    sample = roller.sample
    generator = torch.Generator().manual_seed(seed)
    w = sample.windows
    free = (w.start.held < 0).unsqueeze(-1)
    base = roller.errors([candidate], stride)[0]
    spread = torch.zeros(base.shape[:-1])
    for _ in range(DRAWS if chaos else 0):
        shape, size = w.start.position.shape, free * START * sample.noise
        draw = [torch.randn(shape, generator=generator) * size for _ in range(2)]
        start = w.start.replace(
            position=w.start.position + draw[0], velocity=w.start.velocity + draw[1] / roller.twin.meta.period * 0.3
        )
        moved = dataclasses.replace(sample, windows=dataclasses.replace(w, start=start))
        shaken = dataclasses.replace(roller, sample=moved).errors([candidate], stride)[0]
        spread += (shaken - base).square().mean(dim=-1) / DRAWS
    variance = sample.noise**2 + CHAOS * spread
    if misfit is not None:
        frames = torch.arange(variance.shape[1]).clamp_max(len(misfit) - 1)
        variance = variance + misfit[frames][None, :, None]
    return variance.rsqrt()


def misfit_of(errors: Tensor, seen: Tensor, weights: Weights) -> Tensor:
    """(K,) [m^2] what a sample's residuals (W, K, N, 3) have beyond the variance of `weights`, frame by frame.

    Robust: from the median of the squared residual of each frame over windows and particles.
    """
    excess = (errors.square().mean(dim=-1) - weights.reciprocal().square())
    result = []
    for k in range(errors.shape[1]):
        values = excess[:, k][seen[:, k]]
        result.append(float(values.median()) if len(values) else 0.0)
    smooth = torch.tensor(result).clamp_min(0.0)
    return torch.cummax(smooth, dim=0).values


def seen_of(roller: Roller, stride: int) -> Tensor:
    """(W, K, N) bool."""
    return roller.sample.windows.seen[stride - 1 :: stride].movedim(0, 1)

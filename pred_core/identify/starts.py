"""Where a window starts: position and velocity estimated from several frames, not taken raw from two.

Noise on a start is amplified by the rollout (a track noise of 2 mm at 30 Hz is 0.08 m/s of velocity noise), and the
search would fit it. A local quadratic over 2m+1 frames (Savitzky and Golay 1964) cuts the velocity noise by
sqrt(2 (2m+1)(m)(m+1)/6) against a backward difference; m grows with the noise and shrinks with the bending of the track.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pred_core.train.recordings import Recording
from pred_core.types import Array

WIDEST = 6  # frames on each side


def track_noise(recordings: list[Recording]) -> float:
    """Noise of the tracks [m], from third differences of free particles in the calmest tenth of the frames.

    A third difference of white noise has variance 20 sigma^2; smooth motion contributes little to it.
    """
    calm = []
    for r in recordings:
        free = r.position[:, (r.held[0] < 0)]
        third = torch.diff(free, n=3, dim=0)
        size = third.pow(2).mean(dim=(-1, -2)).sqrt()
        size = size[torch.isfinite(size)]
        if len(size):
            calm.append(torch.quantile(size, 0.1))
    return float(torch.stack(calm).median()) / np.sqrt(20.0) if calm else 0.0


def estimate_start(recording: Recording, frame: int, period: float, noise: float) -> tuple[Tensor, Tensor]:
    """(position (N, 3) [m], velocity (N, 3) [m/s]) at `frame`.

    Each particle takes the widest window whose quadratic fits within twice the noise (Lepski's rule); held
    particles keep their measured position and the gripper's velocity. Without clean frames around: backward
    difference.
    """
    measured = recording.position[frame].double().numpy()
    position, velocity = measured.copy(), (measured - recording.position[frame - 1].double().numpy()) / period
    settled = (recording.held[frame] >= 0).numpy()
    for m in range(1, WIDEST + 1):
        begin, end = frame - m, frame + m + 1
        if begin < 0 or end > len(recording.position):
            break
        span = recording.position[begin:end].double().numpy()
        if not np.isfinite(span).all():
            break
        fit, error = _quadratic(span)
        good = ~settled & (error <= 2.0 * noise)
        position[good], velocity[good] = fit[0][good], fit[1][good] / period
        settled |= ~good
    return torch.as_tensor(position, dtype=torch.float32), torch.as_tensor(velocity, dtype=torch.float32)


def _quadratic(span: Array) -> tuple[Array, Array]:
    """Least squares over (2m+1, N, 3): (coefficients (3, N, 3) in frames, rms residual (N,))."""
    frames = np.arange(len(span)) - len(span) // 2
    basis = np.stack((np.ones(len(span)), frames, frames**2), axis=1)
    flat = span.reshape(len(span), -1)
    coefficients, *_ = np.linalg.lstsq(basis, flat, rcond=None)
    residual = (flat - basis @ coefficients).reshape(span.shape)
    freedom = max(len(span) - 3, 1)
    error = np.sqrt((residual**2).sum(axis=(0, 2)) / (3 * freedom))
    return coefficients.reshape(3, *span.shape[1:]), error

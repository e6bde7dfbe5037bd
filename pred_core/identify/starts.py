"""Where a window starts: position and velocity estimated from several frames, not taken raw from two.

Noise on a start is amplified by the rollout (a track noise of 2 mm at 30 Hz is 0.08 m/s of velocity noise), and the
search would fit it. A quadratic fitted to 2m+1 frames (Savitzky and Golay 1964) has the slope sum(k x_k) / sum(k^2),
k = -m..m, whose noise is sigma / sqrt(m (m+1) (2m+1) / 3) a frame. A backward difference has sigma sqrt(2): the fit
is sqrt(2 m (m+1) (2m+1) / 3) times quieter, 2 for m = 1 and 19 for m = 6. m grows with the noise and shrinks with
the bending of the track.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from pred_core.frames import quaternion_conjugate, quaternion_rotate
from pred_core.train.recordings import Recording
from pred_core.types import Array

WIDEST = 6  # frames on each side
FINEST = 1e-6  # [m] what float32 tracks resolve; three frames always fit, which is the central difference
SURE = 0.99  # share of straight noise that passes the test
CALM = 0.1  # share of the frames the noise is read from


def track_noise(recordings: list[Recording]) -> float:
    """Noise of the tracks [m], from third differences of free particles in the calmest tenth of the frames.

    A third difference of white noise has variance 20 sigma^2; smooth motion contributes little to it. That the calmest
    frames are calm by chance too is corrected: their mean square is a chi-square variable's tenth quantile.
    """
    calm = []
    for r in recordings:
        free = r.position[:, (r.held[0] < 0)]
        third = torch.diff(free, n=3, dim=0)
        size = third.pow(2).mean(dim=(-1, -2)).sqrt()
        size = size[torch.isfinite(size)]
        if len(size):
            numbers = 3 * free.shape[1]
            calm.append(float(torch.quantile(size, CALM)) / np.sqrt(chi2.ppf(CALM, numbers) / numbers))
    return float(np.median(calm)) / np.sqrt(20.0) if calm else 0.0


def estimate_start(recording: Recording, frame: int, period: float, noise: float) -> tuple[Tensor, Tensor]:
    """(position (N, 3) [m], velocity (N, 3) [m/s]) at `frame`.

    Each free particle takes the widest window whose quadratic leaves no more than the noise (a chi-square test, in
    the manner of Lepski). Without clean frames around: backward difference, which lags half a period
    behind. Held particles sit where they are in their gripper on average.
    """
    measured = recording.position[frame].double().numpy()
    position, velocity = measured.copy(), (measured - recording.position[frame - 1].double().numpy()) / period
    held = (recording.held[frame] >= 0).numpy()
    settled = held.copy()
    for m in range(1, WIDEST + 1):
        begin, end = frame - m, frame + m + 1
        if begin < 0 or end > len(recording.position):
            break
        span = recording.position[begin:end].double().numpy()
        if not np.isfinite(span).all():
            break
        fit, error = _quadratic(span)
        freedom = max(3 * (2 * m - 2), 1)
        good = ~settled & (error <= np.sqrt(chi2.ppf(SURE, freedom) / freedom) * max(noise, FINEST))
        position[good], velocity[good] = fit[0][good], fit[1][good] / period
        settled |= ~good
    if held.any():
        position[held] = _gripped(recording, frame)[held]
    return torch.as_tensor(position, dtype=torch.float32), torch.as_tensor(velocity, dtype=torch.float32)


def _quadratic(span: Array) -> tuple[Array, Array]:
    """Least squares over (2m+1, N, 3): (coefficients (3, N, 3) in frames, rms residual (N,))."""
    frames = np.arange(len(span)) - len(span) // 2
    basis = np.stack((np.ones(len(span)), frames, frames**2), axis=1)
    flat = span.reshape(len(span), -1)
    coefficients = np.asarray(np.linalg.pinv(basis) @ flat, dtype=np.float64)
    residual = (flat - basis @ coefficients).reshape(span.shape)
    freedom = max(len(span) - 3, 1)
    error = np.asarray(np.sqrt((residual**2).sum(axis=(0, 2)) / (3 * freedom)), dtype=np.float64)
    return coefficients.reshape(3, *span.shape[1:]), error


def _gripped(recording: Recording, frame: int) -> Array:
    """(N, 3) [m] world: held particles at their mean place in the gripper's frame; other rows mean nothing."""
    span = slice(max(frame - WIDEST, 0), frame + WIDEST + 1)
    holder = recording.held[frame].clamp_min(0).long()
    q = recording.grips.rotation[:, holder].double()
    p = recording.grips.position[:, holder].double()
    offset = quaternion_rotate(quaternion_conjugate(q[span]), recording.position[span].double() - p[span])
    counts = (recording.held[span] == recording.held[frame]) & torch.isfinite(offset).all(dim=-1)
    mean = torch.where(counts[..., None], offset, 0.0).sum(dim=0) / counts.sum(dim=0)[:, None].clamp_min(1)
    return np.asarray((p[frame] + quaternion_rotate(q[frame], mean)).numpy(), dtype=np.float64)

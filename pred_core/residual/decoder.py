"""NeRF-style decoder: Fourier encoding of position and the particle's feature to a velocity (paper III-C)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from pred_core.residual.config import ResidualConfig


def fourier(x: Tensor, octaves: int) -> Tensor:
    """sin and cos of pi 2^k x for k = 0..octaves-1: (..., D) -> (..., 2 octaves D)."""
    scale = math.pi * 2.0 ** torch.arange(octaves, device=x.device, dtype=x.dtype)
    angle = (x.unsqueeze(-1) * scale).flatten(-2)
    return torch.cat((angle.sin(), angle.cos()), dim=-1)


class Decoder(nn.Module):
    """Initial residual velocity (B, N, 3) in units of the cap; zero before training."""

    def __init__(self, config: ResidualConfig):
        super().__init__()
        self.octaves = config.frequencies
        widths = [config.feature + 6 * config.frequencies] + [config.hidden] * config.hidden_layers
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.out = _zero_linear(config.hidden)

    def forward(self, feature: Tensor, position: Tensor) -> Tensor:
        """feature (B, N, feature), position (B, N, 3) [m] in the network's coordinates."""
        x = torch.cat((feature, fourier(position, self.octaves)), dim=-1)
        for layer in self.layers:
            x = functional.relu(layer(x))
        return self.out(x)


class Projection(nn.Module):
    """The variant without decoder (Appendix F): features project straight to velocity."""

    def __init__(self, config: ResidualConfig):
        super().__init__()
        self.out = _zero_linear(config.feature)

    def forward(self, feature: Tensor, position: Tensor) -> Tensor:
        """(B, N, 3) from feature (B, N, feature); `position` is not used."""
        return self.out(feature)


def _zero_linear(width: int) -> nn.Linear:
    """A linear map to 3 that starts at zero, so that an untrained PReD is its simulator."""
    linear = nn.Linear(width, 3)
    nn.init.zeros_(linear.weight)
    nn.init.zeros_(linear.bias)
    return linear

"""Point Transformer V3 encoder: attention inside patches of serialised points (paper III-C, PTv3 [72]).

PTv3's conditional positional encoding (xCPE) is a sparse 3-D convolution. No sparse-convolution library is
needed here: `RelativeConvolution` runs along the serial order that the block has anyway, a depthwise kernel
over the few neighbours before and after each point, whose weights depend on where that neighbour lies in
space. It costs O(N), needs no neighbour search (11 ms at 1,000 points) and is plain torch on every device.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor, nn
from torch.nn import functional

from pred_core.residual.config import ResidualConfig
from pred_core.residual.serialization import ORDERS, serial_orders


@cache
def _patches(count: int, patch: int, device: torch.device) -> tuple[int, Tensor, Tensor]:
    """Patch size S, slots (P*S,) -> rank, rank (N,) -> slot. The last patch borrows from the one before it."""
    patches = -(-count // patch)
    size = -(-count // patches)
    size = size if patches == 1 else min(-(-size // 8) * 8, count)  # whole SIMD lanes
    take = torch.arange(patches * size)
    take[(patches - 1) * size :] = torch.arange(count - size, count)
    back = torch.arange(count)
    back[(patches - 1) * size :] += patches * size - count
    return size, take.to(device), back.to(device)


def shuffled_orders(generator: torch.Generator) -> list[int]:
    """A random permutation of the indices of ORDERS, for `Encoder.forward` in training."""
    return torch.randperm(len(ORDERS), generator=generator).tolist()


class RelativeConvolution(nn.Module):
    """Depthwise aggregation of serial neighbours, weighted by where they lie in space (xCPE)."""

    def __init__(self, feature: int, reach: int):
        super().__init__()
        self.reach = reach
        self.kernel = nn.Parameter(torch.zeros(4, feature))  # constant and gradient part along x, y, z
        nn.init.normal_(self.kernel, std=0.1)

    def forward(self, x: Tensor, basis: Tensor) -> Tensor:
        """(B, N, C) from x (B, N, C) in serial order and `basis` (B, N, 2 reach + 1, 4) of the same order."""
        padded = functional.pad(x, (0, 0, self.reach, self.reach))
        near = padded.unfold(1, 2 * self.reach + 1, 1).transpose(-1, -2)  # (B, N, 2 reach + 1, C), a view
        return ((basis @ self.kernel) * near).sum(dim=-2)


def relative_basis(position: Tensor, reach: int) -> Tensor:
    """(B, N, 2 reach + 1, 4): Gaussian weight w of each serial neighbour, and w r; position (B, N, 3) serial [m].

    r is the offset over the cloud's mean serial spacing, so that the encoding knows no unit of length.
    Slots before the first and after the last point weigh nothing.
    """
    count, width = position.shape[1], 2 * reach + 1
    spacing = (position[:, 1:] - position[:, :-1]).norm(dim=-1).mean(dim=-1).clamp_min(1e-9)
    scaled = position.transpose(1, 2) / spacing[:, None, None]  # (B, 3, N): points last, so passes are contiguous
    padded = functional.pad(scaled, (reach, reach))
    offset = torch.stack([padded[..., i : i + count] for i in range(width)], dim=2) - scaled.unsqueeze(2)
    neighbour = torch.arange(width, device=position.device)[:, None] + torch.arange(
        -reach, count - reach, device=position.device
    )
    inside = (neighbour >= 0) & (neighbour < count)
    weight = torch.exp(-0.125 * offset.square().sum(dim=1)) * (inside / width)  # (B, 2 reach + 1, N)
    return torch.cat((weight.unsqueeze(1), weight.unsqueeze(1) * offset), dim=1).permute(0, 3, 2, 1).contiguous()


class Block(nn.Module):
    """xCPE, patch attention, MLP; pre-norm; everything in the block's own serial order."""

    def __init__(self, config: ResidualConfig):
        super().__init__()
        width = config.feature
        self.heads, self.patch = config.heads, config.patch
        self.position = RelativeConvolution(width, config.reach)
        self.attention_norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.mlp_norm = nn.LayerNorm(width)
        self.mlp_in = nn.Linear(width, config.encoder_feedforward)
        self.mlp_out = nn.Linear(config.encoder_feedforward, width)

    def forward(self, x: Tensor, basis: Tensor) -> Tensor:
        """(B, N, C) -> (B, N, C), both in serial order."""
        x = x + self.position(x, basis)
        x = x + self.out(self._attend(self.qkv(self.attention_norm(x))))
        return x + self.mlp_out(functional.gelu(self.mlp_in(self.mlp_norm(x))))

    def _attend(self, qkv: Tensor) -> Tensor:
        batch, count, width = qkv.shape[0], qkv.shape[1], qkv.shape[2] // 3
        size, take, back = _patches(count, self.patch, qkv.device)
        whole = len(take) == count
        rows = qkv if whole else qkv.index_select(1, take)
        q, k, v = rows.reshape(-1, size, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(q, k, v)  # (B*P, H, S, C/H)
        mixed = mixed.transpose(1, 2).reshape(batch, -1, width)
        return mixed if whole else mixed.index_select(1, back)


class Encoder(nn.Module):
    """Per-particle features (B, N, feature) from input channels (B, N, channels)."""

    def __init__(self, config: ResidualConfig):
        super().__init__()
        self.embed = nn.Linear(config.channels, config.feature)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.encoder_layers))
        self.norm = nn.LayerNorm(config.feature)
        self.reach = config.reach

    def forward(self, channels: Tensor, position: Tensor, shuffle: Sequence[int] | None = None) -> Tensor:
        """Features (B, N, feature). `position` (B, N, 3) [m] orders the points.

        Block i uses order `shuffle[i mod 4]` (an index into ORDERS); None: 0, 1, 2, 3 as at inference.
        """
        batch, count = channels.shape[:2]
        used = [i % len(ORDERS) if shuffle is None else shuffle[i % len(ORDERS)] for i in range(len(self.blocks))]
        base = torch.arange(0, batch * count, count, device=channels.device)[:, None]
        flat = serial_orders(position.detach()) + base  # (4, B, N) indices into points of all clouds
        kept = sorted(set(used))
        serial = position.flatten(0, 1)[flat[kept]].flatten(0, 1)
        bases = dict(zip(kept, relative_basis(serial, self.reach).chunk(len(kept)), strict=True))
        slots = torch.arange(batch * count, device=channels.device)
        x = self.embed(channels).flatten(0, 1)
        rank = slots  # where each point stands in x
        for block, order in zip(self.blocks, used, strict=True):
            along = flat[order].flatten()
            # One gather takes x from the order of the block before to the order of this block.
            x = block(x[rank[along]].view(batch, count, -1), bases[order]).flatten(0, 1)
            rank = torch.empty_like(slots).scatter_(0, along, slots)
        return self.norm(x[rank]).view(batch, count, -1)

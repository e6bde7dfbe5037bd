"""Temporal aggregator: a transformer over the last W initial estimates of each particle (paper III-C).

A standard post-norm transformer encoder, of which only the newest token is read. Two exact rewritings make
it cheap without changing what it computes (a test compares it with `torch.nn.TransformerEncoderLayer`):

- the tokens of the first layer are affine in 3 numbers, e_j = E_j (x_j, 1), so scores are bilinear forms of
  4 x 4 numbers a head and the mixed values need 3 + W numbers a head instead of d / H and a d x d product;
- the last layer computes its newest token only, and pulls W_k and W_v out of the sum over tokens:
  q.W_k e_j = (W_k^T q).e_j and sum_j a_j W_v e_j = W_v sum_j a_j e_j. Terms equal for all j leave a softmax.
"""

from __future__ import annotations

import math
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from pred_core.residual.config import ResidualConfig


def sinusoidal(window: int, width: int) -> Tensor:
    """(W, d) positions of a transformer: sin and cos interleaved, wavelengths 2 pi to 2 pi 10^4."""
    rate = torch.exp(torch.arange(0, width, 2) * (-math.log(1e4) / width))
    angle = torch.arange(window)[:, None] * rate
    return torch.stack((angle.sin(), angle.cos()), dim=-1).flatten(1)


class TemporalLayer(nn.Module):
    """Parameters of one post-norm encoder layer, and its three ways of attending."""

    def __init__(self, width: int, heads: int, feedforward: int):
        super().__init__()
        self.heads, self.head = heads, width // heads
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm_attention = nn.LayerNorm(width)
        self.feed_in = nn.Linear(width, feedforward)
        self.feed_out = nn.Linear(feedforward, width)
        self.norm_feed = nn.LayerNorm(width)

    def finish(self, token: Tensor, mixed: Tensor) -> Tensor:
        """Skip connection, norm, feed-forward, skip connection, norm: (..., d)."""
        x = self.norm_attention(token + mixed)
        return self.norm_feed(x + self.feed_out(functional.relu(self.feed_in(x))))

    def attend_affine(self, window: Tensor, embed: Tensor) -> Tensor:
        """Attention output (W, M, d) of every token of the first layer.

        window (W, M, 3); embed (W, d, 4): token j is embed[j] @ (x_j, 1).
        """
        length, count = window.shape[:2]
        heads, head = self.heads, self.head
        weight = self.qkv.weight.view(3, heads, head, -1)
        lifted = torch.einsum("thcd,wdb->twhcb", weight, embed)  # q, k, v of every slot as maps of (x, 1)
        bias = self.qkv.bias.view(3, 1, heads, head)
        lifted = torch.cat((lifted[..., :3], (lifted[..., 3] + bias).unsqueeze(-1)), dim=-1)
        query, key, value = lifted.unbind(0)  # (W, H, C, 4)
        form = torch.einsum("ihca,jhcb->ijhab", query, key) / math.sqrt(head)
        # Particles last from here on: every elementwise pass runs over contiguous particles.
        moves = window.transpose(1, 2)  # (W, 3, M)
        x1 = functional.pad(moves, (0, 0, 0, 1), value=1.0).contiguous()  # (W, 4, M)
        pairs = (x1[:, None, :, None] * x1[None, :, None, :]).view(length, length, 16, count)  # x_i x_j^T
        score = torch.matmul(form.flatten(3), pairs)  # (W query, W key, H, M)
        share = torch.softmax(score, dim=1)
        motion = (share.unsqueeze(3) * moves[None, :, None]).sum(dim=1)  # (W, H, 3, M)
        out = self.out.weight.view(-1, heads, head)
        moving = torch.einsum("dhc,hcb->hbd", out, value[0, :, :, :3])  # the same for every slot
        resting = torch.einsum("dhc,jhc->jhd", out, value[..., 3])
        mixed = torch.cat((motion.flatten(1, 2), share.flatten(1, 2)), dim=1)  # (W, H (3 + W), M)
        mixing = torch.cat((moving.flatten(0, 1), resting.flatten(0, 1)))
        return mixed.transpose(1, 2) @ mixing + self.out.bias

    def attend_all(self, tokens: Tensor) -> Tensor:
        """Attention output (W, M, d) of every token; tokens (W, M, d)."""
        length, count, width = tokens.shape
        q, k, v = self.qkv(tokens).view(length, count, 3, self.heads, self.head).permute(2, 1, 3, 0, 4)
        mixed = functional.scaled_dot_product_attention(q, k, v)  # (M, H, W, C)
        return self.out(mixed.permute(2, 0, 1, 3).reshape(length, count, width))

    def attend_newest(self, tokens: Tensor) -> Tensor:
        """Attention output (M, d) of the newest token only; tokens (W, M, d)."""
        count, width = tokens.shape[1:]
        wq, wk, wv = self.qkv.weight.chunk(3)
        bq, _, bv = self.qkv.bias.chunk(3)
        query = functional.linear(tokens[-1], wq, bq).view(count, self.heads, self.head) / math.sqrt(self.head)
        pulled = torch.einsum("mhc,hcd->mhd", query, wk.view(self.heads, self.head, width))
        by_particle = tokens.transpose(0, 1)  # (M, W, d)
        share = torch.softmax(pulled @ by_particle.transpose(1, 2), dim=-1)  # (M, H, W)
        mixed = torch.einsum("mhd,hcd->mhc", share @ by_particle, wv.view(self.heads, self.head, width))
        return self.out(mixed.reshape(count, width) + bv)


class Temporal(nn.Module):
    """Residual velocity in units of the cap: (1 - g) initial + g tanh(Proj h)."""

    def __init__(self, config: ResidualConfig):
        super().__init__()
        width = config.embedding
        self.embed = nn.Linear(3, width)
        self.slots: Tensor
        self.register_buffer("slots", sinusoidal(config.window, width), persistent=False)
        self.layers = nn.ModuleList(
            TemporalLayer(width, config.heads, config.feedforward) for _ in range(config.temporal_layers)
        )
        self.offset = nn.Linear(width, 3)
        self.gate = nn.Linear(width, 3)
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)

    def forward(self, window: Tensor) -> Tensor:
        """(B, N, 3) in units of the cap; window (B, W, N, 3) initial estimates, newest last."""
        batch, length, count = window.shape[:3]
        steps = window.transpose(0, 1).reshape(length, batch * count, 3)
        hidden = self.hidden(steps)
        gate = torch.sigmoid(self.gate(hidden))
        return torch.lerp(steps[-1], torch.tanh(self.offset(hidden)), gate).view(batch, count, 3)

    def hidden(self, steps: Tensor) -> Tensor:
        """Output feature h_t (M, d) of the newest token; steps (W, M, 3)."""
        tokens = self.embed(steps) + self.slots[:, None]
        *first, last = cast(list[TemporalLayer], list(self.layers))
        for i, layer in enumerate(first):
            if i == 0:
                start = (self.embed.bias + self.slots).unsqueeze(-1)
                lift = torch.cat((self.embed.weight.expand(len(steps), -1, -1), start), dim=-1)
                mixed = layer.attend_affine(steps, lift)
            else:
                mixed = layer.attend_all(tokens)
            tokens = layer.finish(tokens, mixed)
        return last.finish(tokens[-1], last.attend_newest(tokens))

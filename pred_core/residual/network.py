"""The residual network: encoder, decoder, temporal aggregator (paper III-C, Fig. 3). Pure: memory in, memory out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pred_core.config import from_mapping, to_mapping
from pred_core.errors import TwinError
from pred_core.residual.config import ResidualConfig
from pred_core.residual.decoder import Decoder, Projection, fourier
from pred_core.residual.encoder import Encoder
from pred_core.residual.temporal import Temporal
from pred_core.twin import ResidualWeights

BINDING = 0.95  # an output component beyond this share of the cap counts as bound by it


@dataclass(frozen=True)
class Motion:
    """What the encoder sees of one step, each (B, N, 3) in world: now, one frame before, the simulator's guess."""

    position: Tensor  # [m]
    velocity: Tensor  # [m/s]
    past_position: Tensor  # [m]
    past_velocity: Tensor  # [m/s]
    predicted_position: Tensor  # [m]
    predicted_velocity: Tensor  # [m/s]


@dataclass(frozen=True)
class Buffer:
    """The last W initial estimates of every particle, in units of the cap."""

    window: Tensor  # (B, W, N, 3), oldest first; slots not yet filled repeat the newest
    count: Tensor  # (B,) int32 estimates seen, at most W

    def push(self, newest: Tensor) -> Buffer:
        """The buffer one step later. While it is not full, the open slots repeat `newest` (paper III-C)."""
        length = self.window.shape[1]
        full = (self.count >= length)[:, None, None, None]
        kept = torch.where(full, self.window.roll(-1, dims=1), self.window)
        first = self.count.clamp(max=length - 1)[:, None]
        fresh = torch.arange(length, device=newest.device) >= first
        window = torch.where(fresh[:, :, None, None], newest[:, None], kept)
        return Buffer(window, (self.count + 1).clamp(max=length))

    @classmethod
    def empty(cls, batch: int, length: int, like: Tensor) -> Buffer:
        """No estimate yet; `like` (..., N, 3) gives particles, type and device."""
        window = like.new_zeros(batch, length, *like.shape[-2:])
        return cls(window, torch.zeros(batch, dtype=torch.int32, device=like.device))


class ResidualNetwork(nn.Module):
    """Residual velocity of every particle; zero before training."""

    def __init__(self, config: ResidualConfig):
        """Raises: ConfigError if a size is out of range."""
        super().__init__()
        config.check()
        self.config = config
        self.encoder = Encoder(config)
        self.decoder = Decoder(config) if config.decoder else Projection(config)
        self.temporal = Temporal(config)

    def forward(
        self, motion: Motion, buffer: Buffer, period: float, arc: Tensor, shuffle: Sequence[int] | None = None
    ) -> tuple[Tensor, Buffer]:
        """Residual velocity (B, N, 3) [m/s] world and the buffer that holds this step's initial estimate.

        `arc` (N,) is the material coordinate; `period` [s]; `shuffle` as in `Encoder.forward`.
        """
        position = motion.position
        if self.config.coordinates == "centered":
            position = position - position.mean(dim=-2, keepdim=True)
        feature = self.encoder(self._channels(motion, position, period, arc), position, shuffle)
        initial = self.decoder(feature, position)
        if self.config.bounded:
            initial = torch.tanh(initial)
        buffer = buffer.push(initial)
        return self.config.cap * self.temporal(buffer.window), buffer

    def _channels(self, motion: Motion, position: Tensor, period: float, arc: Tensor) -> Tensor:
        """(B, N, channels): the paper's 18 numbers under an invertible linear change.

        Positions of other times enter as rates and velocities as differences, because raw positions
        10 ms apart differ in the fourth digit, where a float32 network cannot see it.
        """
        channels = [
            position,
            motion.velocity,
            (motion.position - motion.past_position) / period,
            motion.velocity - motion.past_velocity,
            (motion.predicted_position - motion.position) / period,
            motion.predicted_velocity - motion.velocity,
        ]
        if self.config.arc_frequencies:
            encoded = fourier(arc[:, None].to(position), self.config.arc_frequencies)
            channels.append(encoded.expand(*position.shape[:-1], -1))
        return torch.cat(channels, dim=-1)

    def weights(self) -> ResidualWeights:
        """Configuration and tensors as a twin stores them (copies on the CPU)."""
        tensors = {k: v.detach().cpu().clone() for k, v in self.state_dict().items()}
        return ResidualWeights(to_mapping(self.config), tensors)


def build_network(config: ResidualConfig, seed: int) -> ResidualNetwork:
    """A fresh network whose weights depend on `seed` only; the global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return ResidualNetwork(config)


def load_network(weights: ResidualWeights, device: str | torch.device = "cpu") -> ResidualNetwork:
    """The network a twin stores, for inference. Raises: TwinError if tensors and configuration disagree."""
    network = build_network(from_mapping(ResidualConfig, weights.config, "residual.safetensors"), seed=0)
    expected = network.state_dict()
    wrong = sorted(set(expected) ^ set(weights.tensors))
    wrong += [k for k, v in weights.tensors.items() if k in expected and v.shape != expected[k].shape]
    if wrong:
        raise TwinError(
            "residual.safetensors: tensors do not fit their configuration",
            got=", ".join(wrong[:5]),
            next_step="Train the residual again",
        )
    broken = [k for k, v in weights.tensors.items() if not bool(torch.isfinite(v).all())]
    if broken:
        raise TwinError(f"residual.safetensors: '{broken[0]}' is not finite", next_step="Train the residual again")
    network.load_state_dict(dict(weights.tensors))
    return network.to(device).requires_grad_(False).eval()


def binding_share(residual: Tensor, free: Tensor, cap: float) -> Tensor:
    """Share (scalar) of the free particles' components that lie beyond 0.95 of the cap.

    residual (..., N, 3) [m/s]; free (..., N) bool; cap [m/s].
    """
    bound = (residual.abs() > BINDING * cap) & free.unsqueeze(-1)
    return bound.sum() / (3 * free.sum()).clamp_min(1)

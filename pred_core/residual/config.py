"""Sizes and switches of the residual network. Defaults: Table III of the paper (Appendix E)."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.config import check_ranges, setting
from pred_core.errors import ConfigError

COORDINATES = ("world", "centered")


@dataclass(frozen=True)
class ResidualConfig:
    """What is stored beside the weights, so that a twin rebuilds its own network.

    Table III leaves the depth and patch of the encoder open. Four blocks use each of the four orders once.
    """

    feature: int = setting(64, low=8, high=1024, doc="width of the encoder (Table III)")
    encoder_layers: int = setting(4, low=1, high=32, doc="blocks of serialised attention (not in the paper)")
    encoder_feedforward: int = setting(128, low=8, high=4096, doc="width inside a block's MLP (not in the paper)")
    patch: int = setting(48, low=4, high=4096, doc="points that attend to each other (not in the paper)")
    reach: int = setting(3, low=1, high=32, doc="serial neighbours on each side in the positional encoding")
    decoder: bool = setting(True, doc="NeRF-style decoder; off: features project straight to velocity (Appendix F)")
    hidden_layers: int = setting(2, low=1, high=16, doc="of the decoder (Table III)")
    hidden: int = setting(64, low=8, high=1024, doc="width of the decoder (Table III)")
    frequencies: int = setting(6, low=1, high=16, doc="octaves of the Fourier encoding of position, from 1/2 cycle/m")
    window: int = setting(5, low=1, high=64, doc="frames of the temporal window W")
    embedding: int = setting(64, low=8, high=1024, doc="width d of the temporal transformer (Table III)")
    heads: int = setting(4, low=1, high=32, doc="attention heads H, encoder and temporal (Table III)")
    temporal_layers: int = setting(2, low=1, high=16, doc="layers L of the temporal transformer (Table III)")
    feedforward: int = setting(128, low=8, high=4096, doc="width d_ff of the temporal transformer (Table III)")
    cap: float = setting(0.1, unit="m/s", low=1e-6, high=100.0, doc="bound of the residual velocity (Table III)")
    bounded: bool = setting(True, doc="tanh on the initial estimate too, so that the cap bounds the whole output")
    coordinates: str = setting("world", choices=COORDINATES, doc="centered: minus the centroid, for other places")
    arc_frequencies: int = setting(0, low=0, high=16, doc="octaves of Fourier features of the material coordinate")

    @property
    def channels(self) -> int:
        """Input channels of the encoder: the paper's 18, and two per octave of the material coordinate."""
        return 18 + 2 * self.arc_frequencies

    def check(self) -> None:
        """Raise ConfigError if a field is out of range or the heads do not divide the widths."""
        check_ranges(self, "residual")
        for name in ("feature", "embedding"):
            width = getattr(self, name)
            if width % self.heads or width % 2:
                raise ConfigError(f"residual: {name}", got=width, allowed=f"even multiples of {self.heads}")

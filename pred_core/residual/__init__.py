"""Learned residual velocity of PReD (paper III-B, III-C): network, training, checkpoint, report."""

from pred_core.residual.config import ResidualConfig
from pred_core.residual.network import Motion, ResidualNetwork, binding_share, build_network, load_network

__all__ = ["Motion", "ResidualConfig", "ResidualNetwork", "binding_share", "build_network", "load_network"]

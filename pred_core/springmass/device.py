"""Where to simulate: a device by name, refused if this machine does not have it."""

from __future__ import annotations

import torch

from pred_core.errors import ConfigError


def check_device(name: str, where: str = "device") -> None:
    """Raise ConfigError unless `name` is a device that is here: cpu, cuda or cuda:N. `where`: what the user set."""
    here = ["cpu"]
    if torch.cuda.is_available():
        here += ["cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if name not in here:
        missing = "Without a CUDA device and a PyTorch built for it, there is only the CPU" if len(here) == 1 else ""
        raise ConfigError(where, got=name, allowed=", ".join(here), next_step=missing)

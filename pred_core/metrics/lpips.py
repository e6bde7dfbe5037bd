"""LPIPS with the AlexNet backbone (Zhang et al. 2018), from weight files the user names.

    AlexNet conv stack -> five feature maps -> unit length over channels -> squared difference
    -> learned non-negative 1x1 weights -> mean over the image -> sum over layers

Without the files, or with files of another content, it is not computed: never a random-weight distance
under this name.
"""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from pred_core.errors import InputError

NOT_COMPUTED = "not computed"
# torchvision's `alexnet-owt-7be5be79.pth`; torch hub file names carry the first eight digits of the sha256.
ALEXNET_SHA256_PREFIX = "7be5be79"
_KEYS = tuple(f"features.{i}.{p}" for i in (0, 3, 6, 8, 10) for p in ("weight", "bias"))
_CHANNELS = (64, 192, 384, 256, 256)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


@dataclass(frozen=True)
class LpipsFiles:
    """Where the weights are. A sha256 may be given in full or as its leading digits (8 or more)."""

    backbone: Path  # AlexNet state dict with keys features.N.weight
    linear: Path  # LPIPS v0.1 `alex.pth` with keys linN.model.1.weight
    linear_sha256: str
    backbone_sha256: str = ALEXNET_SHA256_PREFIX


class Lpips(nn.Module):
    """`lpips_alex`: perceptual distance between images (..., 3, H, W) with values -1 to 1, returns (...,)."""

    def __init__(self, backbone: dict[str, Tensor], linear: list[Tensor]):
        super().__init__()
        self.features = nn.ModuleList(
            [
                nn.Sequential(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU()),
                nn.Sequential(nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU()),
                nn.Sequential(nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
                nn.Sequential(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
                nn.Sequential(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
            ]
        )
        convolutions = [m for block in self.features for m in block.modules() if isinstance(m, nn.Conv2d)]
        for i, layer in zip((0, 3, 6, 8, 10), convolutions, strict=True):
            layer.load_state_dict({p: backbone[f"features.{i}.{p}"] for p in ("weight", "bias")})
        for index, weight in enumerate(linear):
            self.register_buffer(f"linear{index}", weight.reshape(1, -1, 1, 1))

    @torch.no_grad()
    def forward(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """Distance (...,). Raises: InputError for unequal shapes or values outside -1 to 1."""
        if predicted.shape != measured.shape or predicted.shape[-3] != 3:
            raise InputError("lpips: images differ in shape", got=predicted.shape, allowed=measured.shape)
        for image in (predicted, measured):
            if not bool(((image >= -1.0) & (image <= 1.0)).all()):
                raise InputError("lpips: an image leaves its range", allowed="-1 to 1")
        lead = predicted.shape[:-3]
        shift, scale = predicted.new_tensor(_SHIFT)[:, None, None], predicted.new_tensor(_SCALE)[:, None, None]
        a = (predicted.reshape(-1, *predicted.shape[-3:]) - shift) / scale
        b = (measured.reshape(-1, *measured.shape[-3:]) - shift) / scale
        total = torch.zeros(a.shape[0], dtype=a.dtype, device=a.device)
        for index, block in enumerate(self.features):
            a, b = block(a), block(b)
            difference = (_unit(a) - _unit(b)) ** 2 * getattr(self, f"linear{index}")
            total = total + difference.sum(dim=1).mean(dim=(1, 2))
        return total.reshape(lead)


def load_lpips(files: LpipsFiles | None) -> Lpips | None:
    """The metric, or None ("not computed") when no files are named.

    Raises: InputError if a named file is missing, has another sha256, or holds other tensors.
    """
    if files is None:
        return None
    backbone = _read(files.backbone, files.backbone_sha256)
    linear = _read(files.linear, files.linear_sha256)
    missing = [k for k in _KEYS if k not in backbone]
    lines = [f"lin{i}.model.1.weight" for i in range(5)]
    missing += [k for k in lines if k not in linear]
    if missing:
        raise InputError(f"lpips: tensors are missing: {', '.join(missing[:4])}", allowed="AlexNet, LPIPS v0.1 files")
    sizes = tuple(linear[k].numel() for k in lines)
    if sizes != _CHANNELS:
        raise InputError(f"{files.linear}: not LPIPS weights for AlexNet", got=sizes, allowed=_CHANNELS)
    return Lpips(backbone, [linear[k].float() for k in lines]).eval()


def _read(path: Path, sha256: str) -> dict[str, Tensor]:
    if len(sha256) < 8:
        raise InputError(f"{path}: sha256 too short to tell", got=sha256, allowed="8 to 64 hexadecimal digits")
    if not path.is_file():
        raise InputError(f"{path}: no such weight file", next_step="Name the file, or leave LPIPS not computed")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if not digest.startswith(sha256.lower()):
        raise InputError(f"{path}: sha256 differs", got=digest, allowed=sha256)
    try:
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError) as error:
        raise InputError(f"{path}: not a torch weight file", got=error) from error
    if not isinstance(loaded, dict):
        raise InputError(f"{path}: not a state dict", got=type(loaded).__name__)
    return loaded


def _unit(features: Tensor) -> Tensor:
    return features / (features.pow(2).sum(dim=1, keepdim=True).sqrt() + 1e-10)

"""Point tracks of learned models, loaded from disk when there: CoTracker3 (online) and TAPNext (causal).

Nothing is downloaded. Each is a folder with the model's own repository and its checkpoint; CoTracker3's licence allows
no commercial use. A `PointFollower` gives the paper's rollout and the surface tracker their 2D motion.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.errors import ConfigError
from pred_core.types import Array

Picture = NDArray[np.uint8]


class PointFollower(Protocol):
    """Follows pixels of one camera through a stream of pictures."""

    def start(self, rgb: Picture, pixel: Array) -> None:
        """Begin with pixels (M, 2) of (H, W, 3)."""

    def follow(self, rgb: Picture) -> tuple[Array, NDArray[np.bool_]]:
        """Their pixels (M, 2) in the next picture, and which are visible (M,)."""


class CoTracker3:
    """CoTracker3 online: a window of pictures, moved on by half of it; answers for the newest picture."""

    def __init__(self, folder: Path | None = None, checkpoint: Path | None = None, *, model: Any = None):
        """From a checkout and a checkpoint, or a built `model`. Raises: ConfigError if something is missing."""
        self._model = model if model is not None else _load_cotracker(folder, checkpoint)
        self._frames: list[Picture] = []
        self._queries: Tensor = torch.zeros(1, 0, 3)
        self._last: tuple[Array, NDArray[np.bool_]] | None = None

    def start(self, rgb: Picture, pixel: Array) -> None:
        """Begin with pixels (M, 2)."""
        time = np.zeros((len(pixel), 1))
        self._queries = torch.as_tensor(np.concatenate([time, pixel], axis=1), dtype=torch.float32)[None]
        self._frames, self._last = [rgb], (pixel.copy(), np.ones(len(pixel), bool))
        self._model(_video([rgb]), is_first_step=True, queries=self._queries)

    def follow(self, rgb: Picture) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels and visibility; unchanged until half a window of new pictures has come."""
        if self._last is None:
            raise ConfigError("CoTracker3: nothing to follow", next_step="Call start first")
        self._frames.append(rgb)
        step = int(self._model.step)
        if len(self._frames) % step == 0 and len(self._frames) >= 2 * step:
            self._frames = self._frames[-2 * step :]
            with torch.no_grad():
                tracks, visible = self._model(_video(self._frames), is_first_step=False, queries=self._queries)[:2]
            self._last = tracks[0, -1].double().cpu().numpy(), np.asarray(visible[0, -1].cpu().numpy() > 0.5)
        return self._last


class TapNext:
    """TAPNext: one picture at a time, a recurrent state, no look ahead."""

    def __init__(self, checkpoint: Path | None = None, *, model: Any = None):
        """From a checkpoint and the installed package, or a built `model`. Raises: ConfigError if it is missing."""
        self._model = model if model is not None else _load_tapnext(checkpoint)
        self._state: Any = None

    def start(self, rgb: Picture, pixel: Array) -> None:
        """Begin with pixels (M, 2)."""
        # The model's queries are (time, y, x).
        query = np.concatenate([np.zeros((len(pixel), 1)), pixel[:, ::-1]], axis=1)
        with torch.no_grad():
            *_, self._state = self._model(
                video=_unit_video(rgb), query_points=torch.as_tensor(query, dtype=torch.float32)[None]
            )

    def follow(self, rgb: Picture) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (M, 2) and visibility (M,). Raises: ConfigError before `start`."""
        if self._state is None:
            raise ConfigError("TAPNext: nothing to follow", next_step="Call start first")
        with torch.no_grad():
            tracks, _, visible, self._state = self._model(video=_unit_video(rgb), state=self._state)
        place = tracks[0, -1].double().cpu().numpy()[:, ::-1]
        return np.ascontiguousarray(place), np.asarray(visible[0, -1].reshape(-1).cpu().numpy() > 0.0)


def _video(frames: list[Picture]) -> Tensor:
    """(1, T, 3, H, W) float32, 0 to 255."""
    return torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2)[None].float()


def _unit_video(rgb: Picture) -> Tensor:
    """(1, 1, H, W, 3) float32, -1 to 1."""
    return torch.from_numpy(rgb)[None, None].float() / 127.5 - 1.0


def _checked(model: str, checkpoint: Path | None) -> Path:
    if checkpoint is None or not checkpoint.is_file():
        raise ConfigError(
            f"{model}: no weights on disk",
            got=str(checkpoint),
            next_step="Put the checkpoint there, or use optical flow, which needs none",
        )
    return checkpoint


def _load_cotracker(folder: Path | None, checkpoint: Path | None) -> Any:
    path = _checked("CoTracker3", checkpoint)
    if folder is None or not (folder / "hubconf.py").is_file():
        raise ConfigError("CoTracker3: no checkout of co-tracker", got=str(folder), allowed="a folder with hubconf.py")
    model = torch.hub.load(str(folder), "cotracker3_online", source="local", pretrained=False)
    model.model.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return model.eval()


def _load_tapnext(checkpoint: Path | None) -> Any:
    path = _checked("TAPNext", checkpoint)
    try:
        module = importlib.import_module("tapnet.tapnext.tapnext_torch")
    except ImportError as error:
        raise ConfigError("TAPNext needs the tapnet package", next_step="pip install tapnet") from error
    model = module.TAPNext(image_size=(256, 256))
    model.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return model.eval()

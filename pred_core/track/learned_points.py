"""Point tracks of learned models, loaded from disk when there: CoTracker3 (online) and TAPNext (causal).

Nothing is downloaded: a folder has the checkpoint and, for CoTracker3, the model's own repository, whose licence allows
no commercial use. They give the surface tracker the 2D motion of its particles, beside optical flow.
"""

from __future__ import annotations

import copy
import importlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from pred_core.errors import ConfigError
from pred_core.track.point_follower import Picture, PointFollower
from pred_core.types import Array

MODELS = ("cotracker3", "tapnext")
SIZE = 256  # [px] of the square pictures that TAPNext was trained on


class CoTracker3:
    """CoTracker3 online: a window of pictures, moved on by half of it; it answers once in half a window, for the newest
    picture, and for those between says that it sees nothing.
    """

    def __init__(self, folder: Path | None = None, checkpoint: Path | None = None, *, model: Any = None):
        """From a checkout and a checkpoint, or a built `model`. Raises: ConfigError if something is missing."""
        self._model = model if model is not None else _load_cotracker(folder, checkpoint)
        self._frames: list[Picture] = []
        self._queries: Tensor = torch.zeros(1, 0, 3)
        self._place: Array | None = None

    def another(self) -> CoTracker3:
        """One for another camera, with a model of its own: what it remembers of a video is in the model."""
        return CoTracker3(model=copy.deepcopy(self._model))

    def start(self, rgb: Picture, pixel: Array) -> None:
        """Begin with pixels (M, 2)."""
        time = np.zeros((len(pixel), 1))
        self._queries = torch.as_tensor(np.concatenate([time, pixel], axis=1), dtype=torch.float32)[None]
        self._frames, self._place = [rgb], pixel.copy()
        self._model(_video([rgb]), is_first_step=True, queries=self._queries)

    def follow(self, rgb: Picture) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (M, 2), unchanged until half a window of new pictures has come, and whether these are new and seen."""
        if self._place is None:
            raise ConfigError("CoTracker3: nothing to follow", next_step="Call start first")
        seen = np.zeros(len(self._place), bool)
        self._frames.append(rgb)
        step = int(self._model.step)
        if len(self._frames) % step == 0 and len(self._frames) >= 2 * step:
            self._frames = self._frames[-2 * step :]
            with torch.no_grad():
                tracks, visible = self._model(_video(self._frames), is_first_step=False, queries=self._queries)[:2]
            self._place, seen = tracks[0, -1].double().cpu().numpy(), np.asarray(visible[0, -1].cpu().numpy() > 0.5)
        return self._place, seen


class TapNext:
    """TAPNext: one picture at a time, a recurrent state, no look ahead."""

    def __init__(self, checkpoint: Path | None = None, *, model: Any = None):
        """From a checkpoint and the installed package, or a built `model`. Raises: ConfigError if it is missing."""
        self._model = model if model is not None else _load_tapnext(checkpoint)
        self._state: Any = None

    def another(self) -> TapNext:
        """One for another camera, which shares the model."""
        return TapNext(model=self._model)

    def start(self, rgb: Picture, pixel: Array) -> None:
        """Begin with pixels (M, 2)."""
        # The model's queries are (time, y, x) in a square of SIZE, from the edges of its pixels.
        place = (pixel[:, ::-1] + 0.5) * SIZE / np.array(rgb.shape[:2])
        query = np.concatenate([np.zeros((len(pixel), 1)), place], axis=1)
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
        place = tracks[0, -1].double().cpu().numpy() * np.array(rgb.shape[:2]) / SIZE - 0.5
        return np.ascontiguousarray(place[:, ::-1]), np.asarray(visible[0, -1].reshape(-1).cpu().numpy() > 0.0)


def _video(frames: list[Picture]) -> Tensor:
    """(1, T, 3, H, W) float32, 0 to 255."""
    return torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2)[None].float()


def _unit_video(rgb: Picture) -> Tensor:
    """(1, 1, SIZE, SIZE, 3) float32, -1 to 1."""
    square = interpolate(
        torch.from_numpy(rgb).permute(2, 0, 1)[None].float(), (SIZE, SIZE), mode="bilinear", antialias=True
    )
    return square.permute(0, 2, 3, 1)[None] / 127.5 - 1.0


def load_points(model: str, folder: Path) -> PointFollower:
    """A model of MODELS from its folder: with `hubconf.py` and `scaled_online.pth` for CoTracker3, with one checkpoint,
    `.npz` or `.pt`, for TAPNext. Raises: ConfigError if something is missing.
    """
    if model == "cotracker3":
        return CoTracker3(folder, folder / "scaled_online.pth")
    found = sorted(p for p in folder.glob("*") if p.suffix in (".npz", ".pt"))
    if len(found) > 1:
        raise ConfigError(
            "TAPNext: several checkpoints", got=", ".join(p.name for p in found), allowed="one .npz or .pt a folder"
        )
    return TapNext(found[0] if found else folder / "checkpoint.npz")


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
        utilities = importlib.import_module("tapnet.tapnext.tapnext_torch_utils")
    except ImportError as error:
        raise ConfigError(
            "TAPNext needs the tapnet package", got=error,
            next_step="pip install git+https://github.com/google-deepmind/tapnet",
        ) from error  # fmt: skip
    model = module.TAPNext(image_size=(SIZE, SIZE))
    if path.suffix == ".npz":  # as its authors publish it
        model = utilities.restore_model_from_jax_checkpoint(model, str(path))
    else:
        model.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return model.eval()

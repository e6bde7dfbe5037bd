"""Which pixels are the object: box, table plane, fixtures, robot, then colour once the object has been found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pred_core.track.color_model import ColorModel, Picture, of_same_hue
from pred_core.track.view import Lifter, View
from pred_core.track.workspace import Shape, Workspace, inside_any
from pred_core.types import CameraFrame

WITH_COLOR = 0.25  # share of the clearance that is kept where colour tells object and table apart
FIXTURE_MARGIN = 0.006  # [m] around a fixture whose place is known
STRIDE = 5  # pixels between samples of the background


class ObjectMask:
    """Turns the pictures of all cameras into views that hold the object and little else."""

    def __init__(self, workspace: Workspace):
        self.workspace = workspace
        self.shapes: Sequence[Shape] = ()  # fixtures and robot now
        self.color: ColorModel | None = None
        self._lifters: dict[str, Lifter] = {}

    def view(self, camera: str, frame: CameraFrame, given: NDArray[np.bool_] | None = None) -> View:
        """Candidates in a picture; `given` (H, W) is a mask from elsewhere. Raises: InputError."""
        lifter = self._lifters.setdefault(camera, Lifter(camera, self.workspace))
        view = lifter.lift(frame, 1.0 if self.color is None else WITH_COLOR, self.color)
        keep = np.ones(len(view.pixel), bool) if given is None else given.ravel()[view.pixel]
        if self.shapes:
            keep &= ~inside_any(view.points, self.shapes, FIXTURE_MARGIN)
        return view if keep.all() else view.select(keep)

    def learn(self, frames: Sequence[CameraFrame], members: Sequence[NDArray[np.int64]]) -> ColorModel:
        """Learn the object's colours from its pixels in pictures; everything else is background."""
        mine, others = [], []
        for frame, pixel in zip(frames, members, strict=True):
            flat = frame.rgb.reshape(-1, 3)
            mine.append(flat[pixel])
            rest = np.ones(len(flat), bool)
            if len(pixel):
                rim = _grown(pixel, frame.depth.shape)
                rest[rim[of_same_hue(flat[rim], flat[pixel])]] = False
            sample = np.arange(0, len(flat), STRIDE)
            others.append(flat[sample[rest[sample]]])
        empty: Picture = np.zeros((0, 3), np.uint8)
        model = ColorModel(np.concatenate([empty, *mine]), np.concatenate([empty, *others]))
        self.color = model if model.tells_apart else None
        return model


def _grown(pixel: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Pixels and their neighbours up to 4 away: the object's rim has its colour but often no depth."""
    height, width = shape
    v, u = np.divmod(pixel, width)
    found = [
        np.clip(v + dv, 0, height - 1) * width + np.clip(u + du, 0, width - 1)
        for dv in range(-4, 5, 2)
        for du in range(-4, 5, 2)
    ]
    return np.unique(np.concatenate(found))

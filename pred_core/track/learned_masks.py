"""Masks of learned models, loaded from a folder on disk when there is one: Grounding DINO finds, SAM 2 follows.

Nothing is downloaded. Both come from the `transformers` package; the folders are what `save_pretrained` writes.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.errors import ConfigError

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def check_weights(folder: Path, model: str) -> None:
    """Raise ConfigError unless `folder` holds a saved model."""
    if not (folder / "config.json").is_file():
        raise ConfigError(
            f"{model}: no weights on disk",
            got=str(folder),
            allowed="a folder with config.json and model.safetensors",
            next_step="Save them there with save_pretrained, or use the masks without weights",
        )


def transformers_module(model: str) -> Any:
    """The transformers package. Raises: ConfigError if it, or the torchvision its processors need, is missing."""
    try:
        import torchvision  # noqa: F401
        import transformers
    except ImportError as error:
        raise ConfigError(
            f"{model} needs transformers and torchvision", got=error, next_step="pip install transformers torchvision"
        ) from error
    return transformers


class TextDetector:
    """Grounding DINO: boxes of what a text names."""

    def __init__(self, folder: Path, threshold: float = 0.3, device: str = "cpu"):
        """Raises: ConfigError without weights or without transformers."""
        check_weights(folder, "Grounding DINO")
        t = transformers_module("Grounding DINO")
        self._processor = t.AutoProcessor.from_pretrained(folder, local_files_only=True)
        model = t.GroundingDinoForObjectDetection.from_pretrained(folder, local_files_only=True)
        self._model, self._threshold, self._device = model.to(device).eval(), threshold, device

    def find(self, rgb: Picture, text: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Boxes (B, 4) [px] left, top, right, bottom and scores (B,) of `text` in (H, W, 3), best first."""
        prompt = text.strip().lower().rstrip(".") + "."  # the model wants lower case and a full stop
        inputs = self._processor(images=rgb, text=prompt, return_tensors="pt").to(self._device)
        with torch.no_grad():
            outputs = self._model(**inputs)
        found = self._processor.post_process_grounded_object_detection(
            outputs, inputs["input_ids"], threshold=self._threshold, target_sizes=[rgb.shape[:2]]
        )[0]
        order = torch.argsort(found["scores"], descending=True)
        return found["boxes"][order].double().cpu().numpy(), found["scores"][order].double().cpu().numpy()


class MaskFollower:
    """SAM 2: follows the mask of one object through a stream of pictures, one follower a camera."""

    def __init__(self, folder: Path, device: str = "cpu"):
        """Raises: ConfigError without weights or without transformers."""
        check_weights(folder, "SAM 2")
        t = transformers_module("SAM 2")
        self._processor = t.Sam2VideoProcessor.from_pretrained(folder, local_files_only=True)
        self._model = t.Sam2VideoModel.from_pretrained(folder, local_files_only=True).to(device).eval()
        self._device = device
        self._session: Any = None

    def another(self) -> MaskFollower:
        """One for another camera, which shares the model."""
        other = copy.copy(self)
        other._session = None
        return other

    def start(self, rgb: Picture, box: NDArray[np.float64]) -> Mask:
        """Begin with a box (4,) [px] in (H, W, 3). Returns the mask (H, W)."""
        self._session = self._processor.init_video_session(inference_device=self._device)
        inputs = self._processor(images=rgb, device=self._device, return_tensors="pt")
        self._processor.add_inputs_to_inference_session(
            inference_session=self._session,
            frame_idx=0,
            obj_ids=1,
            input_boxes=[[box.tolist()]],
            original_size=inputs.original_sizes[0],
        )
        return self._run(inputs, rgb.shape[:2])

    def follow(self, rgb: Picture) -> Mask:
        """The mask (H, W) in the next picture. Raises: ConfigError before `start`."""
        if self._session is None:
            raise ConfigError("SAM 2: no object yet", next_step="Call start with a box first")
        return self._run(self._processor(images=rgb, device=self._device, return_tensors="pt"), rgb.shape[:2])

    def _run(self, inputs: Any, size: tuple[int, ...]) -> Mask:
        """The mask of a picture of `size` (height, width): plain numbers, as every version of the package takes."""
        with torch.no_grad():
            outputs = self._model(inference_session=self._session, frame=inputs.pixel_values[0])
        masks = self._processor.post_process_masks([outputs.pred_masks], original_sizes=[size], binarize=True)[0]
        return np.asarray(masks[0, 0].cpu().numpy(), bool)


class NamedObject:
    """Masks of what a text names, in the pictures of several cameras: found once a camera, then followed."""

    def __init__(self, text: str, detector: TextDetector, follower: MaskFollower):
        self._text, self._detector, self._follower = text, detector, follower
        self._following: dict[str, MaskFollower] = {}

    def mask(self, camera: str, rgb: Picture) -> Mask:
        """The mask (H, W) in the camera's next picture (H, W, 3). What was lost is looked for anew."""
        follower = self._following.get(camera)
        if follower is not None:
            mask = follower.follow(rgb)
        else:
            boxes, _ = self._detector.find(rgb, self._text)
            if not len(boxes):
                return np.zeros(rgb.shape[:2], bool)
            follower = self._following[camera] = self._follower.another()
            mask = follower.start(rgb, boxes[0])
        if not mask.any():
            del self._following[camera]
        return mask

    def reset(self) -> None:
        """Look for it anew in every camera."""
        self._following.clear()


def load_named_object(text: str, detector: Path, follower: Path) -> NamedObject:
    """Both models from disk. Raises: ConfigError without weights, packages or a text."""
    if not text.strip():
        raise ConfigError("learned masks need the object's name", next_step="e.g. object:='white rope'")
    return NamedObject(text, TextDetector(detector), MaskFollower(follower))

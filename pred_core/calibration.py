"""What the sensors and the gripper's pose get wrong, and its correction where data enter a twin.

A reported point y at stamp t shows the true point x of a time `delay` earlier, through a similarity:
y(t) = c + s R (x(t - delay) - c) + translation. The true gripper pose is the reported one times a fixed pose in the
gripper's frame. The simulator knows nothing of it: it only ever sees true points and poses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pred_core.config import check_ranges, setting
from pred_core.errors import DatasetError
from pred_core.frames import (
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_rotate,
    quaternion_slerp,
    quaternion_to_rotation_vector,
)
from pred_core.types import Array, Episode, Grip

Three = tuple[float, float, float]
NOTHING: Three = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Calibration:
    """Reported against true; the defaults are the identity."""

    delay: float = setting(0.0, unit="s", low=-1.0, high=1.0, doc="tracks are older than their stamps say")
    scale: float = setting(1.0, low=0.5, high=2.0, doc="of reported over true distances between points")
    rotation: Three = setting(NOTHING, unit="rad", low=-3.2, high=3.2, doc="rotation vector, reported from true points")
    center: Three = setting(NOTHING, unit="m", doc="the point that scale and rotation leave, e.g. the camera's place")
    translation: Three = setting(NOTHING, unit="m", low=-10.0, high=10.0, doc="added to reported points")
    gripper_offset: Three = setting(NOTHING, unit="m", low=-1.0, high=1.0, doc="true origin in the reported frame")
    gripper_rotation: Three = setting(NOTHING, unit="rad", low=-3.2, high=3.2, doc="true axes in the reported frame")

    def __post_init__(self) -> None:
        check_ranges(self, "calibration")

    @property
    def identity(self) -> bool:
        """True if nothing is corrected."""
        return not self.delay and self.moves_nothing and not any(self.gripper_offset + self.gripper_rotation)

    @property
    def moves_nothing(self) -> bool:
        """True if reported points are where the true ones are."""
        return self.scale == 1.0 and not any(self.rotation + self.translation)

    @property
    def matrix(self) -> Array:
        """(3, 3) s R."""
        return self.scale * rotation_matrix(np.array(self.rotation))

    def report(self, true: Array) -> Array:
        """Reported places (..., 3) [m] world of true points; NaN stay NaN."""
        if self.moves_nothing:
            return true
        center = np.array(self.center)
        return center + (true - center) @ self.matrix.T + np.array(self.translation)

    def correct_points(self, reported: Array) -> Array:
        """True places (..., 3) [m] world of reported points; NaN stay NaN."""
        if self.moves_nothing:
            return reported
        center = np.array(self.center)
        return center + (reported - np.array(self.translation) - center) @ np.linalg.inv(self.matrix).T

    def correct_stamp(self, stamp: int) -> int:
        """When what a track with this stamp shows happened [ns]."""
        return stamp - round(self.delay * 1e9)

    def correct_pose(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """True gripper poses (..., 3) [m], (..., 4) wxyz of reported ones."""
        if not any(self.gripper_offset + self.gripper_rotation):
            return position, rotation
        p, q = self._true_pose(torch.as_tensor(position, dtype=torch.float64), torch.as_tensor(rotation).double())
        return p.numpy(), q.numpy()

    def correct(self, episode: Episode) -> Episode:
        """The episode as it truly was: tracks at the times they show, gripper poses at those times.

        Frames for which no gripper pose is known at their true time are left out: the first ones of late tracks, and
        then those up to two in which everything is measured, if the episode began with such. Raises: DatasetError if
        fewer than two frames are left.
        """
        if self.identity:
            return episode
        stamps = episode.stamps - round(self.delay * 1e9)
        kept = np.ones(len(stamps), bool)
        if self.delay:
            kept = (stamps >= episode.stamps[0]) & (stamps <= episode.stamps[-1])
            whole = np.array([np.isfinite(frame).all() for frame in episode.position])
            if whole[:2].all():
                starts = np.flatnonzero(kept[:-1] & kept[1:] & whole[:-1] & whole[1:])
                kept[: starts[0] if len(starts) else len(kept)] = False
        if kept.sum() < 2:
            raise DatasetError(
                f"{episode.name}: too short for the calibration's delay",
                got=f"{len(stamps)} frames, {self.delay:g} s",
                next_step="Leave the episode out",
            )
        grips = poses_at(episode.grips, episode.stamps, stamps[kept]) if self.delay else episode.grips
        position, rotation = self._true_pose(grips.position.double(), grips.rotation.double())
        tracks, color = episode.tracks, episode.tracks.color
        return dataclasses.replace(
            episode,
            stamps=stamps[kept],
            tracks=dataclasses.replace(
                tracks,
                stamp=stamps[kept],
                position=self.correct_points(tracks.position[kept]),
                visible=tracks.visible[kept],
                confidence=tracks.confidence[kept],
                color=color[kept] if color is not None and color.ndim == 3 else color,
            ),
            grips=Grip(position.to(grips.position.dtype), rotation.to(grips.rotation.dtype), grips.closed),
        )

    def then(self, inner: Calibration) -> Calibration:
        """One calibration for both: `inner` was measured on what this one had already corrected."""
        if self.identity:
            return inner
        if inner.identity:
            return self
        center = np.array(inner.center)
        moved = self.report(inner.report(center)) - center
        turn = quaternion_multiply(_quaternion(self.rotation), _quaternion(inner.rotation))
        grip = quaternion_multiply(_quaternion(self.gripper_rotation), _quaternion(inner.gripper_rotation))
        turned = rotation_matrix(np.array(self.gripper_rotation)) @ np.array(inner.gripper_offset)
        return Calibration(
            delay=self.delay + inner.delay,
            scale=self.scale * inner.scale,
            rotation=_three(quaternion_to_rotation_vector(turn)),
            center=inner.center,
            translation=_three(moved),
            gripper_offset=_three(np.array(self.gripper_offset) + turned),
            gripper_rotation=_three(quaternion_to_rotation_vector(grip)),
        )

    def _true_pose(self, position: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        if any(self.gripper_offset):
            position = position + quaternion_rotate(rotation, torch.tensor(self.gripper_offset, dtype=torch.float64))
        if any(self.gripper_rotation):
            rotation = quaternion_multiply(rotation, _quaternion(self.gripper_rotation).expand_as(rotation))
        return position, rotation


def poses_at(grips: Grip, stamps: np.ndarray, at: np.ndarray) -> Grip:
    """Gripper poses (leading axis T) given at `stamps` (T,) [ns], interpolated at `at` (M,) [ns].

    Linear in position, slerp in rotation; before the first and after the last pose that pose counts. A gripper is
    closed as at the nearest stamp.
    """
    after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    weight = np.clip((at - stamps[after - 1]) / (stamps[after] - stamps[after - 1]), 0.0, 1.0)
    w = torch.as_tensor(weight)[:, None]
    a, b = torch.as_tensor(after - 1), torch.as_tensor(after)
    p, q = grips.position.double(), grips.rotation.double()
    place = p[a] + w[..., None] * (p[b] - p[a])
    nearest = torch.where(w[:, 0] < 0.5, a, b)
    turned = quaternion_slerp(q[a], q[b], w.expand(len(at), q.shape[1]))
    return Grip(place.to(grips.position.dtype), turned.to(grips.rotation.dtype), grips.closed[nearest])


def rotation_matrix(vector: Array) -> Array:
    """(3, 3) rotation by a rotation vector (3,) [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def calibration_to_mapping(calibration: Calibration) -> dict[str, Any]:
    """For `calibration.yaml`: value and unit of every field."""
    plain: dict[str, Any] = {}
    for f in dataclasses.fields(calibration):
        value = getattr(calibration, f.name)
        plain[f.name] = {"value": list(value) if isinstance(value, tuple) else value, "unit": f.metadata["unit"]}
    return plain


def calibration_values(entries: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The values of `calibration.yaml`, units left out. Raises: DatasetError naming the key."""
    try:
        return {key: entry["value"] for key, entry in entries.items()}
    except (TypeError, KeyError, AttributeError) as error:
        raise DatasetError(f"{source}: each entry needs a 'value'", got=error) from error


def _quaternion(vector: Three) -> Tensor:
    return quaternion_from_rotation_vector(torch.tensor(vector, dtype=torch.float64))


def _three(values: Any) -> Three:
    x, y, z = (float(v) for v in values)
    return x, y, z

"""The tracker: pictures of any number of cameras in, particles out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE
from pred_core.config import setting
from pred_core.errors import ConfigError, InputError, nearest
from pred_core.track.estimate import Estimate, Prior
from pred_core.track.grasp import GripperPath
from pred_core.track.line_config import LineConfig
from pred_core.track.line_tracker import LineTracker
from pred_core.track.mask import ObjectMask
from pred_core.track.picture_clock import PictureClock
from pred_core.track.point_follower import PointFollower
from pred_core.track.surface_tracker import SurfaceConfig, SurfaceTracker
from pred_core.track.view import View, check_frame
from pred_core.track.workspace import Shape, Workspace, check_workspace
from pred_core.types import Array, CameraFrame, Capsule

MOST_CAMERAS = 8
GONE = 10_000_000_000  # [ns] without pictures after which the object is searched anew
PRIOR_AGE = 0.5  # [s] from the pictures, beyond which a prior is not used
HEARD = 1.0  # [s] for which a gripper that is there, but silent, is waited for before a line is begun


@dataclass(frozen=True)
class TrackerConfig:
    """What is tracked, where, and for how long a picture counts."""

    kind: str = setting("line", choices=("line", "sheet", "volume"), doc="geometry class of the object")
    window: float = setting(0.12, unit="s", low=0.0, high=2.0, doc="a picture older than the newest by more is stale")
    arm_radius: float = setting(0.0, unit="m", low=0.0, high=0.3, doc="of the arm above each gripper; 0: none in view")
    arm_start: float = setting(0.05, unit="m", low=-0.5, high=0.5, doc="from the tool centre along the gripper's +z")
    arm_end: float = setting(0.4, unit="m", low=-0.5, high=2.0, doc="from the tool centre along the gripper's +z")
    workspace: Workspace = Workspace()
    line: LineConfig = LineConfig()
    surface: SurfaceConfig = SurfaceConfig()


class Masks(Protocol):
    """Where the object is in a picture, from a learned model."""

    def mask(self, camera: str, rgb: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """The mask (H, W) in the camera's next picture (H, W, 3)."""

    def reset(self) -> None:
        """Look for the object anew."""


class Tracker:
    """Online and causal. Feed `add_frame` in any order; `step` takes what is new."""

    def __init__(
        self,
        config: TrackerConfig,
        cameras: Sequence[str],
        masks: Masks | None = None,
        follower: PointFollower | None = None,
    ):
        """`masks`: a learned model's, beside workspace, table and colour; sheets and volumes only begin there.
        `follower`: a learned model's point tracks, for sheets and volumes.

        Raises: ConfigError for no camera, more than eight, or an empty workspace.
        """
        if not 1 <= len(set(cameras)) == len(cameras) <= MOST_CAMERAS:
            raise ConfigError(
                "tracker: cameras",
                got=", ".join(cameras) or "none",
                allowed=f"1 to {MOST_CAMERAS}, each once",
                next_step="Name them, e.g. cameras:=cam0,cam1",
            )
        check_workspace(config.workspace)
        self.config, self.cameras, self._masks, self._follower = config, tuple(cameras), masks, follower
        self.mask = ObjectMask(config.workspace)
        self.fixtures: tuple[Shape, ...] = ()
        self.robot: tuple[Shape, ...] = ()
        self.stale = 0  # pictures that came too late to be used
        self._line, self._surface = LineTracker(config.line), SurfaceTracker(config.surface, follower)
        self._path = GripperPath()
        self._clock = PictureClock()
        self._closed: NDArray[np.bool_] = np.zeros(0, bool)
        self._frames: dict[str, CameraFrame] = {}  # new ones
        self._views: dict[str, View] = {}  # used ones
        self._given: dict[str, NDArray[np.bool_]] = {}  # masks of the pictures in use
        self._prior: Prior | None = None
        self._searching = True

    @property
    def searching(self) -> bool:
        """True until the object has been found."""
        return self._searching

    def add_grip(self, stamp: int, position: Array, rotation: Array, closed: NDArray[np.bool_]) -> None:
        """Measured gripper poses (G, 3) [m], (G, 4) wxyz and flags (G,), () while they are not known yet.

        Raises: InputError if not finite, for another number of flags, or for a stamp out of line (`GripperPath.add`).
        """
        if len(closed) not in (0, len(position)):
            raise InputError(
                f"{GRIPPER_CLOSED} does not match {GRIPPER_POSE}",
                got=f"{len(closed)} flags",
                allowed=len(position),
                next_step="Send one flag a gripper",
            )
        self._closed = closed
        self._path.add(stamp, position, rotation)

    def set_prior(self, prior: Prior | None) -> None:
        """Where the predictor expects the particles; used until the next one, or for PRIOR_AGE."""
        self._prior = prior

    def add_frame(self, camera: str, frame: CameraFrame) -> None:
        """A new picture; an unused older one of this camera is dropped. Where time has gone back, or leapt by more than
        GONE, the object is searched anew.

        Raises: InputError for a picture that cannot be used, or is off the time line of the others.
        """
        if camera not in self.cameras:
            raise InputError(f"unknown camera '{camera}'", next_step=nearest(camera, self.cameras))
        check_frame(frame, camera)
        leap = self._clock.take(camera, frame.stamp)
        if leap < 0 or leap > GONE:
            self.reset()
        if frame.stamp < self._stamp - self.config.window * 1e9:
            self.stale += 1
            return
        self._frames[camera] = frame

    def step(self) -> Estimate | None:
        """Use the new pictures. None: nothing new, or the object is not found yet."""
        if not self._frames:
            return None
        frames, self._frames = self._frames, {}
        stamp = max(max(f.stamp for f in frames.values()), self._stamp)
        poses = self._path.at(stamp)
        self.mask.shapes = (*self.fixtures, *self.robot, *self._arms(poses))
        if self.config.kind == "line" or self._searching:
            if self._masks is not None:
                self._given = {c: self._masks.mask(c, f.rgb) for c, f in frames.items()}
            self._look(frames)
        oldest = stamp - self.config.window * 1e9
        self._views = {c: v for c, v in self._views.items() if v.stamp >= oldest}
        views = [self._views[c] for c in self.cameras if c in self._views]
        if self._searching:
            late = self._path.expected(stamp, HEARD)  # it says which end of a line is the first: ids keep that
            if late or self.blind_to_arm(poses) or not self._find(views, frames, stamp, poses):
                return None
            views = [self._views[v.camera] for v in views]
        prior = self._prior if self._prior is not None and abs(stamp - self._prior.stamp) * 1e-9 < PRIOR_AGE else None
        if self.config.kind == "line":
            estimate = self._line.update(views, stamp, poses, prior, self.mask.color)
        else:
            estimate = self._surface.update(frames, stamp, poses, prior)
        if estimate.status == "lost":
            self._searching = True
        return estimate

    def blind_to_arm(self, poses: tuple[Array, Array] | None) -> bool:
        """An arm is in view and nobody has said where: it would be taken for the object."""
        return self.config.arm_radius > 0.0 and (poses is None or not len(self._closed))

    @property
    def _stamp(self) -> int:
        return self._line.stamp if self.config.kind == "line" else self._surface.stamp

    def reset(self) -> None:
        """Forget the object; it is searched in the next pictures."""
        self._line = LineTracker(self.config.line)
        self._surface = SurfaceTracker(self.config.surface, self._follower)
        self.mask.color = None
        self._frames, self._views, self._searching = {}, {}, True
        if self._masks is not None:
            self._masks.reset()

    def _find(
        self, views: list[View], frames: dict[str, CameraFrame], stamp: int, poses: tuple[Array, Array] | None
    ) -> bool:
        if not any(len(v.pixel) for v in views):
            return False
        if self.config.kind != "line":
            self._searching = not self._surface.start(views, frames, stamp, poses, self._closed)
            return not self._searching
        members = self._line.start(views, stamp, poses, self._closed)
        if not members:
            return False
        if self.mask.color is None:
            pairs = [(frames[m.camera], m.pixel) for m in members if m.camera in frames]
            self.mask.learn([f for f, _ in pairs], [p for _, p in pairs])
            self._look(frames)
        self._searching = False
        return True

    def _look(self, frames: dict[str, CameraFrame]) -> None:
        """Candidates in the pictures, within what a learned model says where there is one."""
        self._views.update({c: self.mask.view(c, f, self._given.get(c)) for c, f in frames.items()})

    def _arms(self, poses: tuple[Array, Array] | None) -> tuple[Shape, ...]:
        """The arm as a capsule above each gripper."""
        c = self.config
        if poses is None or c.arm_radius == 0.0:
            return ()
        shapes = []
        for place, turn in zip(*poses, strict=True):
            start, end = (tuple((place + turn[:, 2] * d).tolist()) for d in (c.arm_start, c.arm_end))
            shapes.append(Capsule(start, end, c.arm_radius))
        return tuple(shapes)

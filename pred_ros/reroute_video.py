"""The video of a run: a camera's pictures with the tracked rope, the goal, and the gripper's planned way drawn in.

VP8 in WebM: OpenCV's wheels write it without a licence, and current browsers and players show it.
"""

from __future__ import annotations

import contextlib
import os
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import ConfigError
from pred_core.types import Array
from pred_ros.reroute_record import NS, Record, View

Picture = NDArray[np.uint8]
GOAL, TRACKED, WAY, EVENT, INK = (200, 160, 40), (0, 200, 255), (60, 110, 255), (80, 80, 255), (255, 255, 255)  # BGR
SHOWN = 1.5  # [s] of the cell's time that an event stays in the picture
FRESH = 0.3  # [s] older tracks are not drawn
MARGIN = 0.25  # of the size of what is looked at, around it
SIZE = (800, 600)  # [px] of the video
NEAR = 0.05  # [m] in front of the camera; nearer points are not drawn


def write_video(record: Record, path: Path) -> int:
    """Write the pictures from the begin on, in their own time; returns how many there were (0: no file). Where some are
    missing, the one before stays.

    Raises: ConfigError if OpenCV is missing or cannot write this format.
    """
    frames = [(s, jpeg) for s, jpeg in record.pictures if s >= record.begin]
    if not frames or record.view is None:
        return 0
    cv2 = _opencv()
    rate = NS / spacing_of([s for s, _ in frames])
    with _quiet():
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"VP80"), rate, SIZE)
    if not writer.isOpened():
        raise ConfigError("this OpenCV cannot write VP8 video", next_step="pip install 'opencv-python-headless<5'")
    height, width = _decoded(frames[0][1]).shape[:2]
    view, part = closer(record, record.view, width, height)
    shown = 0
    for k, (stamp, jpeg) in enumerate(frames):
        picture = draw(record, view, stamp, cv2.warpAffine(_decoded(jpeg), part, SIZE))
        until = frames[k + 1][0] if k + 1 < len(frames) else stamp + NS / rate
        while shown < round((until - frames[0][0]) * rate / NS):
            writer.write(picture)
            shown += 1
    writer.release()
    return len(frames)


def spacing_of(stamps: Sequence[int]) -> float:
    """[ns] between two pictures of the camera, also where most of them are missing; 0.1 s where there is only one."""
    return float(np.quantile(np.diff(stamps), 0.1)) if len(stamps) > 1 else 0.1 * NS


def closer(record: Record, view: View, width: int, height: int) -> tuple[View, Array]:
    """The camera that sees only the part in which goal and rope lie, enlarged to SIZE, and that part (2, 3): its pixels
    from those of a picture of width x height. Where nothing lies in front of the camera: the middle.
    """
    seen = np.concatenate([project(view, record.goal), *[project(view, p) for _, p in record.truth[::20]]])
    if not len(seen):
        seen = np.array([[0, 0], [width, height]], np.int32)
    low, high = seen.min(axis=0), seen.max(axis=0)
    wanted = float((np.array(SIZE) / (1.0 + 2.0 * MARGIN) / np.maximum(high - low, 1)).min())
    scale = max(wanted, SIZE[0] / width, SIZE[1] / height)
    span = np.array(SIZE) / scale
    corner = np.clip((low + high) / 2 - span / 2, 0.0, np.array([width, height]) - span)
    turn = np.array([[scale, 0.0, -scale * corner[0]], [0.0, scale, -scale * corner[1]], [0.0, 0.0, 1.0]])
    return View(view.name, turn @ view.intrinsics, view.world_from_camera), turn[:2]


def draw(record: Record, view: View, stamp: int, picture: Picture) -> Picture:
    """A picture (H, W, 3) BGR taken at `stamp` [ns], with what was known then."""
    cv2 = _opencv()
    for u, v in project(view, record.goal).tolist():
        cv2.circle(picture, (u, v), 2, GOAL, -1, cv2.LINE_AA)
    plans = [p for p in record.plans if p.stamp <= stamp]
    if plans:
        cv2.polylines(picture, [project(view, plans[-1].position)], False, WAY, 2, cv2.LINE_AA)
    k = bisect_right(record.tracked, stamp, key=lambda row: row[0]) - 1
    if k >= 0 and stamp - record.tracked[k][0] < FRESH * NS:
        for u, v in project(view, record.tracked[k][1]).tolist():
            cv2.circle(picture, (u, v), 3, TRACKED, 1, cv2.LINE_AA)
    _write(picture, f"{record.seconds(stamp):5.1f} s", (10, 24), INK)
    judged = bisect_right(record.judged, stamp, key=lambda row: row[0]) - 1
    if judged >= 0 and record.judged[judged][1].success:
        _write(picture, "through the slot", (110, 24), TRACKED)
    for when, text in record.events:
        if 0 <= stamp - when < SHOWN * NS:
            _write(picture, text, (10, 50), EVENT)
    right = picture.shape[1] - 180
    for k, (text, colour) in enumerate((("tracked", TRACKED), ("goal", GOAL), ("plan of the gripper", WAY))):
        _write(picture, text, (right, 24 + 20 * k), colour)
    return picture


def project(view: View, points: Array) -> NDArray[np.int32]:
    """Pixels (M, 2) of those of the points (N, 3) [m] world that lie in front of the camera."""
    pose = view.world_from_camera
    p_camera = (np.asarray(points, float) - pose[:3, 3]) @ pose[:3, :3]
    p_camera = p_camera[p_camera[:, 2] > NEAR]
    pixels = p_camera @ view.intrinsics.T
    return np.round(pixels[:, :2] / pixels[:, 2:]).astype(np.int32)


def _decoded(jpeg: bytes) -> Picture:
    """(H, W, 3) BGR."""
    cv2 = _opencv()
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def _write(picture: Picture, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2 = _opencv()
    for width, shade in ((4, (30, 30, 30)), (1, colour)):
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, shade, width, cv2.LINE_AA)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """OpenCV's C library prints that it does not know the format's tag, and writes it."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise ConfigError("a video needs OpenCV", next_step="pip install 'opencv-python-headless<5'") from error
    return cv2  # type: ignore[no-any-return]

"""The video of a run: the part of the pictures that is shown, and a file that plays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="OpenCV is not installed")

import cv2

from pred_core.plant.live.slot import SlotConfig
from pred_ros import reroute_video
from pred_ros.reroute_record import Record, View

S = 1_000_000_000  # [ns]
WIDTH, HEIGHT = 320, 240  # [px]
VIEW = View("cam0", np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]]), np.eye(4))  # looks along +z


def record_of(goal: np.ndarray) -> Record:
    """Three pictures, 0.1 s apart."""
    record = Record(SlotConfig(), goal)
    jpeg = cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))[1].tobytes()
    record.pictures = [(k * S // 10, jpeg) for k in range(3)]
    record.view = VIEW
    record.now = S
    return record


def test_the_part_shown_keeps_the_camera_and_enlarges_what_matters() -> None:
    # 0.1 m at 1 m are 30 px around (160, 120); 800 / 1.5 / 30 = 17.8 times would fit across, 600 / 1.5 / 30 = 13.3 up.
    square = np.array([[x, y, 1.0] for x in (-0.05, 0.05) for y in (-0.05, 0.05)])
    view, part = reroute_video.closer(record_of(square), VIEW, WIDTH, HEIGHT)
    assert part[0, 0] == part[1, 1] == pytest.approx(13.33, abs=0.01)
    assert reroute_video.project(view, np.array([[0.0, 0.0, 1.0]]))[0].tolist() == [400, 300], "the middle stays it"
    old = reroute_video.project(VIEW, square) @ part[:, :2].T + part[:, 2]
    assert np.abs(reroute_video.project(view, square) - old).max() < 1.0, "pixels and camera move together"


@pytest.mark.parametrize("goal", [np.array([[0.0, 0.0, -1.0]]), np.array([[0.0, 0.0, 1.0]])], ids=["behind", "before"])
def test_a_video_is_written_also_where_nothing_lies_before_the_camera(goal: np.ndarray, tmp_path: Path) -> None:
    record = record_of(goal)
    assert reroute_video.write_video(record, tmp_path / "video.webm") == 3
    film = cv2.VideoCapture(str(tmp_path / "video.webm"))
    found, picture = film.read()
    assert found and picture.shape == (600, 800, 3)


def test_where_pictures_are_missing_the_one_before_stays_for_their_time(tmp_path: Path) -> None:
    record = record_of(np.array([[0.0, 0.0, 1.0]]))
    jpeg = record.pictures[0][1]
    record.pictures = [(k * S // 10, jpeg) for k in (0, 1, 2, 3, 10, 20, 21)]
    assert reroute_video.write_video(record, tmp_path / "video.webm") == 7
    film = cv2.VideoCapture(str(tmp_path / "video.webm"))
    frames = 0
    while film.read()[0]:
        frames += 1
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0) and frames == 22, "2.2 s from the first to after the last"

def test_the_part_is_found_once_for_all_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, original = [], reroute_video.closer

    def counted(*given: object) -> object:
        asked.append(1)
        return original(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(reroute_video, "closer", counted)
    reroute_video.write_video(record_of(np.array([[0.0, 0.0, 1.0]])), tmp_path / "video.webm")
    assert len(asked) == 1

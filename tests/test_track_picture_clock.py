"""Stamps of pictures: a camera with a wrong clock neither stops nor kills the tracker; a new recording begins anew."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from track_scenes import LENGTH, STEP, HangingRope

from pred_core.errors import InputError
from pred_core.track.line_config import LineConfig
from pred_core.track.picture_clock import PictureClock
from pred_core.track.tracker import Tracker, TrackerConfig
from pred_core.track.workspace import Workspace

S = 1_000_000_000
CONFIG = TrackerConfig(
    workspace=Workspace((-0.5, -0.5, 0.0), (0.5, 0.5, 0.9)), line=LineConfig(particles=26, length=LENGTH)
)


def taken(stamps: list[tuple[str, float]]) -> list[float | None]:
    """What the clock says of each (camera, seconds): the leap [s], or None where the picture is refused."""
    clock, found = PictureClock(), []
    for camera, seconds in stamps:
        try:
            found.append(clock.take(camera, round(seconds * S)) / S)
        except InputError:
            found.append(None)
    return found


def test_time_goes_on() -> None:
    assert taken([("a", 10.0), ("b", 10.01), ("a", 9.97), ("b", 10.9), ("a", 11.8)]) == [0.0] * 5


def test_one_camera_off_the_others_time_is_refused_again_and_again() -> None:
    wrong = [("a", 30.0 + 0.1 * n) for n in range(6)]
    good = [("b", 10.0 + 0.1 * n) for n in range(6)]
    found = taken([("b", 9.9), *(pair for two in zip(wrong, good, strict=True) for pair in two)])
    assert found == [0.0, *[None, 0.0] * 6]


def test_two_cameras_or_three_pictures_in_a_row_move_time() -> None:
    assert taken([("a", 10.0), ("a", 40.0), ("b", 40.0), ("a", 40.1)]) == [0.0, None, 30.0, 0.0]
    assert taken([("a", 10.0), ("a", 2.0), ("a", 2.1), ("a", 2.2), ("a", 2.3)]) == [0.0, None, None, -7.8, 0.0]
    assert taken([("a", 10.0), ("a", 2.0), ("a", 50.0), ("a", 2.2), ("a", 90.0)]) == [0.0, None, None, None, None]


def test_the_refusal_names_camera_and_clock() -> None:
    clock = PictureClock()
    clock.take("cam1", 10 * S)
    with pytest.raises(InputError) as error:
        clock.take("cam0", 30 * S)
    assert str(error.value).startswith("cam0: a picture 20.0 s ahead of the others; got stamp 30.000 s")
    assert "check the camera's clock" in str(error.value)


def test_the_refusal_of_the_only_camera_does_not_speak_of_others() -> None:
    clock = PictureClock()
    clock.take("cam0", 10 * S)
    with pytest.raises(InputError, match="cam0: a picture 6.1 s ahead of its last one; .*after an outage they do"):
        clock.take("cam0", round(16.1 * S))


@pytest.fixture
def scene() -> Iterator[HangingRope]:
    rope = HangingRope()
    yield rope
    rope.close()


def follow(tracker: Tracker, scene: HangingRope, begin: int, count: int) -> int:
    """Estimates out of `count` instants from `begin` [ns] on."""
    found = 0
    for k in range(count):
        stamp = begin + k * STEP
        tracker.add_grip(**scene.grip(stamp))
        for name, frame in scene.frames(stamp).items():
            with contextlib.suppress(InputError):
                tracker.add_frame(name, frame)
        found += tracker.step() is not None
    return found


@pytest.mark.parametrize("off", [5.0, 20.0, 3600.0, -13.0])
def test_a_picture_from_another_time_changes_nothing(scene: HangingRope, off: float) -> None:
    tracker = Tracker(CONFIG, list(scene.cameras.configs))
    assert follow(tracker, scene, 20 * S, 6) >= 5
    stamp = 20 * S + 6 * STEP
    wrong = next(iter(scene.frames(stamp + round(off * S)).items()))
    with pytest.raises(InputError, match=wrong[0]):
        tracker.add_frame(*wrong)
    assert follow(tracker, scene, stamp, 6) == 6


@pytest.mark.parametrize("off", [-13.0, 60.0])
def test_a_new_recording_is_searched_anew(scene: HangingRope, off: float) -> None:
    tracker = Tracker(CONFIG, list(scene.cameras.configs))
    assert follow(tracker, scene, 20 * S, 6) >= 5
    assert follow(tracker, scene, 20 * S + round(off * S), 6) >= 5

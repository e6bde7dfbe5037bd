"""Where a line ends in a drawn picture whose answer is known, and what is done with it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pred_core.track.color_model import ColorModel
from pred_core.track.line_ends import LineEnds, extended, past_end
from pred_core.track.view import View
from pred_core.types import Array, CameraFrame

END, RADIUS = 0.1, 0.004  # [m] x of the line's end, without its rounding
WIDTH, HEIGHT, FOCAL = 320, 240, 300.0  # a pixel is 3.3 mm at 1 m
ORANGE, GREY = np.array([217.0, 92.0, 20.0]), np.array([120.0, 118.0, 110.0])
PIXEL = 0.001  # [m] a third of a pixel: its colour tells how much of it the line fills


def drawn(end: float = END) -> CameraFrame:
    """A line from x = -0.2 m to `end`, seen from 1 m; the depth has a hole around its end, as stereo makes it."""
    fine = 8
    u, v = (np.arange(n * fine) / fine + 0.5 / fine - 0.5 for n in (WIDTH, HEIGHT))
    x, z = (u - 0.5 * (WIDTH - 1)) / FOCAL, (v - 0.5 * (HEIGHT - 1)) / FOCAL
    away = np.hypot(x[None] - np.clip(x, -0.2, end)[None], z[:, None])
    share = (away <= RADIUS).reshape(HEIGHT, fine, WIDTH, fine).mean(axis=(1, 3))
    rgb = np.round(share[..., None] * ORANGE + (1.0 - share[..., None]) * GREY).astype(np.uint8)
    depth = np.where(share > 0.5, 1.0 - RADIUS, 1.5).astype(np.float32)
    column = round(0.5 * (WIDTH - 1) + FOCAL * end)
    depth[:, column - 4 : column + 4] = np.nan
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # it looks along +y
    pose[:3, 3] = (0.0, -1.0, 0.0)
    k = np.array([[FOCAL, 0.0, 0.5 * (WIDTH - 1)], [0.0, FOCAL, 0.5 * (HEIGHT - 1)], [0.0, 0.0, 1.0]])
    return CameraFrame(1, rgb, depth, k, pose)


def seen(frame: CameraFrame) -> View:
    """The picture; the walk along a line uses no points."""
    none = np.zeros((0, 3))
    return View("cam0", 1, none, none, np.zeros(0), none.astype(np.uint8), np.zeros(0, np.int64), frame)


def line_to(x: float) -> Array:
    """(31, 3) nodes from x = -0.2 m."""
    return np.linspace((-0.2, 0.0, 0.0), (x, 0.0, 0.0), 31)


@pytest.fixture
def color() -> ColorModel:
    rng = np.random.default_rng(0)
    mine, other = (np.clip(rng.normal(c, 4.0, (2000, 3)), 0, 255).astype(np.uint8) for c in (ORANGE, GREY))
    return ColorModel(mine, other)


@pytest.mark.parametrize("short", [-0.012, 0.0, 0.008, 0.0213])
def test_colour_finds_the_end_where_depth_has_a_hole(color: ColorModel, short: float) -> None:
    assert past_end(line_to(END - short), RADIUS, seen(drawn()), color) == pytest.approx(short, abs=PIXEL)
    both = LineEnds()
    both.watch(line_to(END - short)[::-1], RADIUS, [seen(drawn())], color)
    first, last = both.correction((False, False))
    assert first == pytest.approx(short, abs=PIXEL) and last == pytest.approx(0.0, abs=PIXEL)


@pytest.mark.parametrize("end", [END - 0.0023, END - 0.0011, END + 0.0008, END + 0.0019])
def test_the_end_is_found_between_pixels(color: ColorModel, end: float) -> None:
    assert past_end(line_to(END), RADIUS, seen(drawn(end)), color) == pytest.approx(end - END, abs=PIXEL)


def test_what_cannot_be_told_is_not_told(color: ColorModel) -> None:
    frame = drawn()
    jaws = frame.depth.copy()
    jaws[:, round(0.5 * (WIDTH - 1) + FOCAL * (END - 0.01)) :] = 0.9
    rgb = frame.rgb.copy()
    rgb[:, round(0.5 * (WIDTH - 1) + FOCAL * (END - 0.01)) :] = GREY.astype(np.uint8)
    hidden = dataclasses.replace(frame, depth=jaws, rgb=rgb)
    assert past_end(line_to(END), RADIUS, seen(hidden), color) is None, "jaws stand before its end"
    assert past_end(line_to(0.5), RADIUS, seen(drawn(0.6)), color) is None, "its end is outside the picture"
    across = np.linspace((END + 0.01, 0.0, -0.2), (END + 0.01, 0.0, 0.2), 41)
    loop = np.concatenate([across, [[-0.2, 0.0, 0.2]], line_to(END)])
    assert past_end(loop, RADIUS, seen(drawn()), color) is None, "another part of the line lies there"
    side = dataclasses.replace(frame, world_from_camera=_along_x())
    assert past_end(line_to(END), RADIUS, seen(side), color) is None, "the camera looks along the line"


def _along_x() -> Array:
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose[:3, 3] = (-1.0, 0.0, 0.0)
    return pose


def test_the_middle_of_many_pictures_counts_and_a_held_end_stays(color: ColorModel) -> None:
    ends = LineEnds()
    for end in (END, END + 0.002, END + 0.03):  # one picture in three is wrong
        ends.watch(line_to(END), RADIUS, [seen(drawn(end))], color)
    assert ends.correction((True, False)) == (0.0, pytest.approx(0.002, abs=PIXEL))
    assert ends.correction((False, True))[1] == 0.0
    ends.moved(0.0, 0.002)  # what was found is counted from the end, which has been moved
    assert ends.correction((True, False))[1] == pytest.approx(0.0, abs=PIXEL)


def test_a_polyline_is_made_longer_and_shorter() -> None:
    longer = extended(line_to(END), 0.02, -0.015)
    np.testing.assert_allclose(longer[[0, -1], 0], [-0.22, END - 0.015], atol=1e-12)
    assert (np.diff(longer[:, 0]) > 0.0).all()
    np.testing.assert_array_equal(extended(line_to(END), 0.0, 0.0), line_to(END))

"""Rendered RGB-D frames: pixels and depths where geometry puts them, depth noise of the size it claims."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

import mujoco

from pred_core.errors import ConfigError, InputError
from pred_core.plant.appearance import dress_rope, dress_spec
from pred_core.plant.cameras import CameraConfig, Cameras, look_at, ring_of_cameras
from pred_core.plant.rope import RopeConfig, build_rope
from pred_core.plant.stereo_noise import NO_NOISE, StereoNoise, add_noise

BALL, RADIUS = np.array([0.1, 0.05, 0.05]), 0.01  # [m] world
SMALL: dict[str, Any] = {"width": 320, "height": 240}


@pytest.fixture(scope="module")
def world() -> Iterator[tuple[Any, Any]]:
    """A rope, a table and a blue ball whose place is known."""
    rope = build_rope(RopeConfig())
    dress_spec(rope.spec)
    dress_rope(rope)
    ball = rope.spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], pos=BALL.tolist())
    ball.rgba, ball.contype, ball.conaffinity = [0.0, 0.0, 1.0, 1.0], 0, 0
    model = rope.spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:3] = (0.2, 0.1, 0.8)
    mujoco.mj_forward(model, data)
    yield model, data


def test_look_at_has_z_forward_and_y_down() -> None:
    pose = look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(pose[:3, 2], (-1.0, 0.0, 0.0), atol=1e-12)  # forward
    np.testing.assert_allclose(pose[:3, 1], (0.0, 0.0, -1.0), atol=1e-12)  # down
    np.testing.assert_allclose(pose[:3, 0], (0.0, 1.0, 0.0), atol=1e-12)  # right: y x z with x towards us
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_a_camera_that_looks_at_itself_is_refused() -> None:
    with pytest.raises(ConfigError, match="same point"):
        look_at((1.0, 0.0, 0.0), (1.0, 0.0, 0.0))


def test_a_ball_appears_where_the_pinhole_puts_it(world: tuple[Any, Any]) -> None:
    model, data = world
    with Cameras(model, ring_of_cameras(3, **SMALL), NO_NOISE) as cameras:
        for name in cameras.configs:
            frame = cameras.frame(data, name, 7, np.random.default_rng(0))
            camera_from_world = np.linalg.inv(frame.world_from_camera)
            place = camera_from_world[:3, :3] @ BALL + camera_from_world[:3, 3]
            pixel = frame.intrinsics @ place / place[2]
            blue = frame.rgb[..., 2].astype(int) - frame.rgb[..., 0] > 60
            v, u = np.nonzero(blue)
            # About 30 pixels across: the middle of its rim is known to a tenth of a pixel or so.
            np.testing.assert_allclose((u.mean(), v.mean()), pixel[:2], atol=0.25)
            # The nearest point of the ball lies one radius before its middle; 0.2 mm for the pixel raster.
            assert np.linalg.norm(place) - RADIUS == pytest.approx(
                frame.depth[blue].min() * np.linalg.norm(place) / place[2], abs=3e-4
            )


def test_lifted_table_pixels_lie_on_the_table(world: tuple[Any, Any]) -> None:
    model, data = world
    with Cameras(model, ring_of_cameras(1, **SMALL), NO_NOISE) as cameras:
        frame = cameras.frame(data, "cam0", 7, np.random.default_rng(0))
    v, u = np.mgrid[0:240, 0:320]
    ray = np.stack((u, v, np.ones_like(u)), -1) @ np.linalg.inv(frame.intrinsics).T
    points = (ray * frame.depth[..., None]) @ frame.world_from_camera[:3, :3].T + frame.world_from_camera[:3, 3]
    assert np.abs(np.median(points[..., 2])) < 1e-6  # float32 depth at 1 m


def test_the_same_seed_gives_the_same_picture(world: tuple[Any, Any]) -> None:
    model, data = world
    with Cameras(model, ring_of_cameras(1, **SMALL)) as cameras:
        one, two = (cameras.frame(data, "cam0", 7, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(one.depth, two.depth)
    np.testing.assert_array_equal(one.rgb, two.rgb)


def test_disparity_noise_grows_with_the_square_of_depth() -> None:
    noise = StereoNoise(holes=0.0, dropout=0.0, quantum=0.0)
    for depth in (0.5, 1.0, 2.0):
        flat = np.full((200, 200), depth, np.float32)
        error = add_noise(flat, 600.0, noise, np.random.default_rng(0)) - flat
        # z^2 e / (f b): at 1 m with 0.08 px, 600 px and 0.095 m that is 1.40 mm. 40,000 values, 9 to a patch: 3 %.
        assert error.std() == pytest.approx(depth**2 * 0.08 / (600.0 * 0.095), rel=0.04)


def test_half_the_pixels_beside_an_edge_and_one_in_a_hundred_have_no_depth() -> None:
    step = np.ones((400, 400), np.float32)
    step[:, 200:] = 1.5
    measured = add_noise(step, 600.0, StereoNoise(disparity=0.0), np.random.default_rng(0))
    assert np.isnan(measured[:, 199:201]).mean() == pytest.approx(0.5, abs=0.1)  # 800 pixels in patches of 9
    assert np.isnan(measured[:, :190]).mean() == pytest.approx(0.01, abs=0.002)  # 76,000 pixels: 0.0004 is one sigma


def test_bad_requests_are_named(world: tuple[Any, Any]) -> None:
    model, data = world
    with pytest.raises(ConfigError, match="none"):
        Cameras(model, ())
    with pytest.raises(ConfigError, match="each name once"):
        Cameras(model, (CameraConfig("a"), CameraConfig("a")))
    hint = "did you mean 'cam0'"
    with Cameras(model, ring_of_cameras(1, **SMALL)) as cameras, pytest.raises(ConfigError, match=hint):
        cameras.frame(data, "cam9", 0, np.random.default_rng(0))


def test_missing_egl_names_the_package(world: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    egl = pytest.importorskip("mujoco.egl", reason="no libEGL here", exc_type=ImportError)

    def broken(width: int, height: int) -> None:
        raise ImportError("Cannot initialize a EGL device display")

    monkeypatch.setattr(egl, "GLContext", broken)
    with pytest.raises(InputError, match="apt install libegl1 libgl1-mesa-dri"):
        Cameras(world[0], ring_of_cameras(1))

"""Camera messages: what is written is read back, and what is no picture is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pred_core.bag import images
from pred_core.bag.wire import decode, encode
from pred_core.errors import BagError


def picture(encoding: str, data: bytes, height: int, width: int, step: int) -> SimpleNamespace:
    return SimpleNamespace(encoding=encoding, data=data, height=height, width=width, step=step, is_bigendian=0)


def test_colour_orders_and_padded_rows() -> None:
    # One row of two pixels, 6 bytes of 8: red then blue
    raw = bytes([255, 0, 0, 0, 0, 255, 9, 9])
    assert images.read_color(picture("rgb8", raw, 1, 2, 8), "t").tolist() == [[[255, 0, 0], [0, 0, 255]]]
    assert images.read_color(picture("bgr8", raw, 1, 2, 8), "t").tolist() == [[[0, 0, 255], [255, 0, 0]]]
    assert images.read_color(picture("mono8", bytes([7, 8]), 1, 2, 2), "t").tolist() == [[[7] * 3, [8] * 3]]
    with pytest.raises(BagError, match="size of the picture"):
        images.read_color(picture("rgb8", raw[:-1], 1, 2, 8), "t")
    with pytest.raises(BagError, match="encoding; got 'yuv422'"):
        images.read_color(picture("yuv422", raw, 1, 2, 8), "t")


def test_depth_in_metres_and_millimetres_is_the_same() -> None:
    metres = np.array([[1.234, np.nan, 0.5]], np.float32)
    raw = np.array([[1234, 0, 500]], np.uint16)
    a = images.read_depth(picture("32FC1", metres.tobytes(), 1, 3, 12), "t")
    b = images.read_depth(picture("16UC1", raw.tobytes(), 1, 3, 6), "t")
    assert np.isnan(a[0, 1]) and np.isnan(b[0, 1])
    assert a[0, ::2] == pytest.approx(b[0, ::2], abs=1e-6)
    assert images.millimetres(metres).tolist() == raw.tolist()
    assert images.millimetres(np.array([[70.0, -1.0, np.inf]], np.float32)).tolist() == [[0, 0, 0]], "none, not wrapped"


def test_compressed_pictures_through_the_wire() -> None:
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    depth = np.round(np.random.default_rng(0).uniform(0.3, 2.0, (24, 32)), 3).astype(np.float32)
    depth[3, 4] = np.nan
    rgb = np.zeros((24, 32, 3), np.uint8)
    rgb[:, 16:] = (250, 120, 10)
    packed = images.make_compressed(5, "cam0", images.DEPTH_FORMAT, images.compress_depth(depth))
    unpacked = images.read_depth_compressed(decode(encode(packed), images.COMPRESSED, "t"), "t")
    assert np.isnan(unpacked[3, 4]) and np.nanmax(np.abs(unpacked - depth)) < 1e-6
    packed = images.make_compressed(5, "cam0", "rgb8; jpeg compressed bgr8", images.compress_color(rgb))
    seen = images.read_color_compressed(decode(encode(packed), images.COMPRESSED, "t"), "t")
    assert np.abs(seen[12, 28].astype(int) - [250, 120, 10]).max() < 12, "JPEG"
    packed.data = packed.data[:20]
    with pytest.raises(BagError, match="not a picture"):
        images.read_color_compressed(packed, "t")
    with pytest.raises(BagError, match="16 bit PNG"):
        images.read_depth_compressed(images.make_compressed(5, "cam0", images.DEPTH_FORMAT, b"x" * 30), "t")


def test_calibration_and_pose_through_the_wire() -> None:
    k = np.array([[600.0, 0, 319.5], [0, 601.0, 239.5], [0, 0, 1]])
    info = decode(encode(images.make_camera_info(7, "cam1", k, 480, 640)), images.CAMERA_INFO, "t")
    assert images.read_camera_info(info, "t")[0].tolist() == k.tolist() and info.header.frame_id.startswith("cam1_")
    info.k = np.zeros(9)
    with pytest.raises(BagError, match="no calibration"):
        images.read_camera_info(info, "t")
    for turn in (np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1]),
                 np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])):  # fmt: skip
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, (0.1, -0.2, 0.9)
        made = images.make_camera_pose(7, pose[:3, 3], images.rotation_of(pose))
        assert images.read_camera_pose(decode(encode(made), images.POSE_STAMPED, "t"), "t") == pytest.approx(pose)
    far = images.make_camera_pose(7, 1e3 * pose[:3, 3], images.rotation_of(pose))
    with pytest.raises(BagError, match=r"millimetres\?; got 900 m from the origin"):
        images.read_camera_pose(far, "t")
    made.header.frame_id = "map"
    with pytest.raises(BagError, match="frame_id"):
        images.read_camera_pose(made, "t")

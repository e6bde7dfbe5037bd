"""Camera messages <-> numpy: colour, depth, calibration, pose; raw on the wire, compressed in bags.

Reads message objects of any origin (a bag, a live subscription): only their fields are used. Compression needs OpenCV.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.clouds import LARGEST_COORDINATE
from pred_core.bag.wire import check_frame, make_header, message_type
from pred_core.errors import BagError, ConfigError

Color = NDArray[np.uint8]
Depth = NDArray[np.float32]
Array = NDArray[np.float64]

COLOR, DEPTH, INFO, POSE = "color/image_raw", "depth/image_raw", "color/camera_info", "pose"  # below `camN/`
COLOR_COMPRESSED, DEPTH_COMPRESSED = f"{COLOR}/compressed", f"{DEPTH}/compressedDepth"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, POSE_STAMPED = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/PoseStamped"
DEPTH_FORMAT = "16UC1; compressedDepth png"
DEPTH_HEADER = 12  # [bytes] before the PNG: the plugin's configuration, all zero for 16UC1
FARTHEST = 65.534  # [m] in 16UC1 millimetres; 0 = none
_CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0)}


def optical_frame(camera: str) -> str:
    """The frame of a camera's pictures (REP-103)."""
    return f"{camera}_color_optical_frame"


def raw_topic(topic: str) -> str:
    """The topic on which a driver sends what a bag may hold compressed; any other topic as it is."""
    return topic.removesuffix("/compressedDepth").removesuffix("/compressed")


def read_color(message: Any, where: str) -> Color:
    """(H, W, 3) RGB of a colour image. Raises: BagError for another encoding or a wrong size."""
    order = _CHANNELS.get(message.encoding)
    if order is None:
        raise BagError(f"{where}: encoding", got=repr(message.encoding), allowed=", ".join(_CHANNELS))
    depth = 1 if message.encoding == "mono8" else len(message.encoding) - 1
    pixels = _rows(message, depth, where).reshape(message.height, message.width, depth)
    return np.ascontiguousarray(pixels[..., list(order)])


def read_depth(message: Any, where: str) -> Depth:
    """(H, W) [m], NaN = none, of a depth image in 32FC1 metres or 16UC1 millimetres (REP-118). Raises: BagError."""
    if message.encoding == "32FC1":
        bits = _rows(message, 4, where).copy().view(">f4" if message.is_bigendian else "<f4")
        depth = bits.reshape(message.height, message.width).astype(np.float32)
        return np.where(depth > 0.0, depth, np.float32(np.nan))
    if message.encoding == "16UC1":
        bits = _rows(message, 2, where).copy().view(">u2" if message.is_bigendian else "<u2")
        return metres(bits.reshape(message.height, message.width))
    raise BagError(f"{where}: encoding", got=repr(message.encoding), allowed="32FC1, 16UC1")


def read_camera_info(message: Any, where: str) -> tuple[Array, tuple[int, int]]:
    """Intrinsics (3, 3) [px] and (height, width). Raises: BagError for an uncalibrated camera."""
    k = np.array([float(v) for v in message.k]).reshape(3, 3)
    if not np.isfinite(k).all() or k[0, 0] <= 0.0 or k[1, 1] <= 0.0 or not message.width or not message.height:
        raise BagError(
            f"{where}: no calibration",
            got=f"k = {k.ravel().tolist()}, {message.width} x {message.height}",
            next_step="Calibrate the camera, or start its driver with a calibration file",
        )
    return k, (int(message.height), int(message.width))


def read_camera_pose(message: Any, where: str) -> Array:
    """world_from_camera (4, 4). Raises: BagError for another frame, or a quaternion that is not a rotation."""
    check_frame(message, where)
    p, q = message.pose.position, message.pose.orientation
    values = np.array([p.x, p.y, p.z, q.w, q.x, q.y, q.z], float)
    norm = float(np.linalg.norm(values[3:]))
    if not np.isfinite(values).all() or abs(norm - 1.0) > 1e-3:
        raise BagError(f"{where}: not a pose", got=values.tolist(), allowed="finite metres and a unit quaternion")
    if np.abs(values[:3]).max() > LARGEST_COORDINATE:
        raise BagError(
            f"{where}: implausibly far away, are these millimetres?",
            got=f"{np.abs(values[:3]).max():.4g} m from the origin",
            allowed=f"at most {LARGEST_COORDINATE:g} m",
            next_step="Write metres",
        )
    w, x, y, z = values[3:] / norm
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = values[:3]
    return pose


def read_color_compressed(message: Any, where: str) -> Color:
    """(H, W, 3) RGB of a JPEG or PNG. Raises: BagError if it cannot be unpacked, ConfigError without OpenCV."""
    cv2 = _opencv()
    picture = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise BagError(f"{where}: not a picture", got=f"{len(message.data)} bytes of '{message.format}'")
    return np.ascontiguousarray(picture[..., ::-1])


def read_depth_compressed(message: Any, where: str) -> Depth:
    """(H, W) [m], NaN = none, of a `compressedDepth` PNG in 16UC1. Raises: BagError, ConfigError without OpenCV."""
    cv2 = _opencv()
    if not message.format.startswith("16UC1"):
        raise BagError(f"{where}: format", got=repr(message.format), allowed=DEPTH_FORMAT)
    picture = cv2.imdecode(np.frombuffer(bytes(message.data)[DEPTH_HEADER:], np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint16 or picture.ndim != 2:
        raise BagError(f"{where}: not a 16 bit PNG after {DEPTH_HEADER} bytes", got=f"{len(message.data)} bytes")
    return metres(picture)


def millimetres(depth: Depth) -> NDArray[np.uint16]:
    """(H, W) 16UC1 of depth [m]; NaN, and what is too far to be written, becomes 0, which means none."""
    known = np.isfinite(depth) & (depth > 0.0) & (depth <= FARTHEST)
    return np.where(known, np.round(1000.0 * np.where(known, depth, 0.0)), 0.0).astype(np.uint16)


def compress_color(rgb: Color, quality: int = 90) -> bytes:
    """JPEG of (H, W, 3). Raises: ConfigError without OpenCV."""
    cv2 = _opencv()
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data.tobytes())


def compress_depth(depth: Depth) -> bytes:
    """What `compressedDepth` sends for 16UC1: an empty configuration, then a PNG. Raises: ConfigError."""
    cv2 = _opencv()
    _, data = cv2.imencode(".png", millimetres(depth), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return bytes(DEPTH_HEADER) + bytes(data.tobytes())


def make_compressed(stamp: int, camera: str, format: str, data: bytes) -> Any:
    """sensor_msgs/CompressedImage."""
    header = make_header(stamp, optical_frame(camera))
    return message_type(COMPRESSED)(header=header, format=format, data=np.frombuffer(data, np.uint8))


def make_camera_info(stamp: int, camera: str, intrinsics: Array, height: int, width: int) -> Any:
    """sensor_msgs/CameraInfo of a camera without distortion."""
    k = np.asarray(intrinsics, float)
    projection = np.concatenate([k, np.zeros((3, 1))], axis=1)
    region = message_type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
    return message_type(CAMERA_INFO)(
        header=make_header(stamp, optical_frame(camera)), height=height, width=width, distortion_model="plumb_bob",
        d=np.zeros(5), k=k.ravel(), r=np.eye(3).ravel(), p=projection.ravel(), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip


def make_camera_pose(stamp: int, position: Array, rotation: Array) -> Any:
    """geometry_msgs/PoseStamped in world; rotation (4,) wxyz."""
    point = message_type("geometry_msgs/msg/Point")(*(float(v) for v in position))
    w, x, y, z = (float(v) for v in rotation)
    pose = message_type("geometry_msgs/msg/Pose")(point, message_type("geometry_msgs/msg/Quaternion")(x, y, z, w))
    return message_type(POSE_STAMPED)(make_header(stamp), pose)


def rotation_of(world_from_camera: Array) -> Array:
    """(4,) wxyz of the rotation in a pose (4, 4), w >= 0 (Shepperd 1978)."""
    m = np.asarray(world_from_camera, float)[:3, :3]
    squares = np.array([np.trace(m), *np.diag(m)])
    k = int(squares.argmax())
    q = np.empty(4)
    if k == 0:
        q[0] = 1.0 + squares[0]
        q[1:] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i, j, n = k - 1, k % 3, (k + 1) % 3
        q[0] = m[n, j] - m[j, n]
        q[1 + i] = 1.0 + m[i, i] - m[j, j] - m[n, n]
        q[1 + j], q[1 + n] = m[j, i] + m[i, j], m[n, i] + m[i, n]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0.0 else q


def _rows(message: Any, bytes_a_pixel: int, where: str) -> Color:
    """The pixels' bytes (H, W * bytes_a_pixel) without the padding of rows. Raises: BagError."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    # One copy of what may be a list-like buffer; arrays of bytes are taken as they are.
    data = np.frombuffer(message.data, np.uint8)
    if height < 1 or width < 1 or step < width * bytes_a_pixel or data.size != height * step:
        raise BagError(
            f"{where}: size of the picture",
            got=f"{height} rows of {step} bytes, {data.size} bytes in all",
            allowed=f"{width} pixels of {bytes_a_pixel} bytes a row",
        )
    return data.reshape(height, step)[:, : width * bytes_a_pixel]


def metres(picture: NDArray[np.uint16]) -> Depth:
    """(H, W) [m], NaN = none, of 16UC1 millimetres."""
    depth = picture.astype(np.float32) * np.float32(1e-3)
    depth[picture == 0] = np.nan
    return depth


def _opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise ConfigError(
            "compressed pictures need OpenCV", next_step="pip install 'opencv-python-headless<5'"
        ) from error
    return cv2  # type: ignore[no-any-return]

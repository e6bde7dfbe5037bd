"""PointCloud2 of tracked, estimated and predicted particles <-> numpy arrays.

Reads message objects of any origin (a bag, a live subscription): only their fields are used.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.wire import check_frame, make_header, message_type, stamp_of
from pred_core.errors import BagError

# sensor_msgs/PointField datatype -> numpy
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_CODES = {np.dtype(name): code for code, name in _DTYPES.items()}

Layout = Mapping[str, str]  # field name -> numpy type, in wire order
TRACKER_LAYOUT: Layout = {"x": "f4", "y": "f4", "z": "f4", "id": "u4", "confidence": "f4", "rgb": "u4"}
STATE_LAYOUT: Layout = {
    "x": "f4", "y": "f4", "z": "f4", "vx": "f4", "vy": "f4", "vz": "f4", "id": "u4", "held": "i4",
}  # fmt: skip
POINT_REQUIRED: Layout = {"x": "f4", "y": "f4", "z": "f4", "id": "u4"}
_OPTIONAL = {"confidence": ("f4",), "rgb": ("u4", "f4")}  # PCL writes the packed colour as float32

LARGEST_EXTENT = 10.0  # [m] of one cloud; a larger one is millimetres written as metres
LARGEST_COORDINATE = 100.0  # [m] from the world origin
LARGEST_POINT = 1 << 16  # [bytes]
_MAX_DAMAGE_LISTED = 5


@dataclass(frozen=True)
class PointFrame:
    """One `tracker/points` message."""

    stamp: int  # [ns] header
    position: NDArray[np.float64]  # (P, 3) [m] world; NaN where hidden
    id: NDArray[np.uint32]  # (P,)
    confidence: NDArray[np.float32]  # (P,), 0 = hidden
    color: NDArray[np.uint8] | None  # (P, 3)

    @property
    def visible(self) -> NDArray[np.bool_]:
        """(P,) measured in this message."""
        return self.confidence > 0


def cloud_array(message: Any, required: Layout, where: str) -> NDArray[Any]:
    """Structured array (P,) of a PointCloud2, fields by name. Raises: BagError on another layout."""
    fields = tuple((f.name, int(f.offset), int(f.datatype), int(f.count)) for f in message.fields)
    step = int(message.point_step)
    found = _layout(fields, step, bool(message.is_bigendian), tuple(required.items()))
    problem = found if isinstance(found, str) else ""
    width, height, row = int(message.width), int(message.height), int(message.row_step)
    data = np.frombuffer(message.data, np.uint8)
    if not problem and width * height and (row < width * step or data.size != row * height):
        problem = f"{height} x {width} points of {step} bytes, row_step {row}, do not fit {data.size} bytes"
    if problem:
        described = [f"{name} {_DTYPES.get(kind, f'datatype {kind}')}" for name, _, kind, _ in fields]
        raise BagError(
            f"{where}: unknown field layout, {problem}",
            got=", ".join(described) or "no fields",
            allowed=", ".join(f"{name} {kind}" for name, kind in required.items()),
        )
    if not width * height:
        return np.zeros(0, found)
    rows = np.ascontiguousarray(data.reshape(height, row)[:, : width * step])
    return rows.reshape(-1).view(found)


@functools.lru_cache(maxsize=64)
def _layout(
    fields: tuple[tuple[str, int, int, int], ...], step: int, big_endian: bool, required: tuple[tuple[str, str], ...]
) -> np.dtype[Any] | str:
    """The numpy type of a point from (name, offset, datatype, count) of its fields, or what is wrong with them."""
    kinds = {name: (_DTYPES.get(datatype), count) for name, _, datatype, count in fields}
    if len(kinds) != len(fields):
        return "a field is named twice"
    if step > LARGEST_POINT:
        return f"point_step {step} is larger than {LARGEST_POINT}"
    end = 0
    for name, offset, datatype, count in sorted(fields, key=lambda f: f[1]):
        kind = _DTYPES.get(datatype)
        if kind is None or count < 1:
            return f"field '{name}' has datatype {datatype} and count {count}"
        if offset < end:
            return f"field '{name}' overlaps the one before it"
        end = offset + np.dtype(kind).itemsize * count
        if end > step:
            return f"field '{name}' ends beyond point_step {step}"
    for name, wanted in required:
        if name not in kinds:
            return f"no field '{name}'"
        if kinds[name] != (wanted, 1):
            return f"field '{name}' is not one {wanted}"
    for name, allowed in _OPTIONAL.items():
        if name in kinds and kinds[name] not in [(kind, 1) for kind in allowed]:
            return f"field '{name}' is not one {' or '.join(allowed)}"
    used = [f for f in fields if f[3] == 1]
    order = ">" if big_endian else "<"
    return np.dtype(
        {
            "names": [name for name, _, _, _ in used],
            "formats": [order + _DTYPES[datatype] for _, _, datatype, _ in used],
            "offsets": [offset for _, offset, _, _ in used],
            "itemsize": step,
        }
    )


def read_tracker_points(message: Any, where: str) -> PointFrame:
    """The particles of a `tracker/points` message.

    Raises: BagError for another frame or layout, a confidence outside 0..1, coordinates that are not
    finite at a confidence above 0, a repeated id, or an extent only millimetres explain.
    """
    check_frame(message, where)
    cloud = cloud_array(message, POINT_REQUIRED, where)
    where = f"{where} at {stamp_of(message) * 1e-9:.3f} s"
    ids = np.ascontiguousarray(cloud["id"]).astype(np.uint32)
    names = cloud.dtype.names or ()
    confidence = cloud["confidence"].astype(np.float32) if "confidence" in names else np.ones(len(ids), np.float32)
    bad = ~((confidence >= 0) & (confidence <= 1))
    if bad.any():
        raise BagError(f"{where}: confidence of ids {_some(ids[bad])}", got=_some(confidence[bad]), allowed="0 to 1")
    ordered = np.sort(ids)
    repeated = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(repeated):
        raise BagError(f"{where}: duplicate ids {_some(np.unique(repeated))}", allowed="each particle once a message")
    with np.errstate(invalid="ignore"):  # a signalling NaN warns when cast; NaN is looked for below
        position = np.stack([cloud[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    visible = confidence > 0
    bad = visible & ~np.isfinite(position).all(-1)
    if bad.any():
        raise BagError(
            f"{where}: coordinates of visible ids {_some(ids[bad])} are not finite",
            got=_some(position[bad][0]),
            next_step="Give a hidden particle confidence 0 or leave it out",
        )
    position[~visible] = np.nan
    check_extent(position[visible], where)
    return PointFrame(stamp_of(message), position, ids, confidence, _color(cloud))


def check_extent(position: NDArray[np.float64], where: str) -> None:
    """Raise BagError if points (P, 3) [m] span more than a workspace: they are not in metres."""
    if not len(position):
        return
    extent = float(np.ptp(position, axis=0).max())
    farthest = float(np.abs(position).max())
    if extent > LARGEST_EXTENT or farthest > LARGEST_COORDINATE:
        raise BagError(
            f"{where}: implausible extent, are these millimetres?",
            got=f"{extent:.4g} m across, {farthest:.4g} m from the origin",
            allowed=f"at most {LARGEST_EXTENT:g} m across and {LARGEST_COORDINATE:g} m away",
            next_step="Write metres",
        )


def make_tracker_points(frame: PointFrame) -> Any:
    """A `tracker/points` message; rgb is left out when the frame has no colours."""
    layout = {k: v for k, v in TRACKER_LAYOUT.items() if k != "rgb" or frame.color is not None}
    cloud = np.zeros(len(frame.id), np.dtype([(name, "<" + kind) for name, kind in layout.items()]))
    for axis, name in enumerate("xyz"):
        cloud[name] = frame.position[:, axis]
    cloud["id"], cloud["confidence"] = frame.id, frame.confidence
    if frame.color is not None:
        red, green, blue = (frame.color[:, c].astype(np.uint32) for c in range(3))
        cloud["rgb"] = (red << 16) | (green << 8) | blue
    return make_cloud(cloud, frame.stamp)


def make_cloud(cloud: NDArray[Any], stamp: int) -> Any:
    """A PointCloud2 in `world` of a little-endian structured array (P,)."""
    field_type = message_type("sensor_msgs/msg/PointField")
    fields = [
        field_type(name=name, offset=offset, datatype=_CODES[dtype.newbyteorder("=")], count=1)
        for name, (dtype, offset) in ((n, cloud.dtype.fields[n][:2]) for n in cloud.dtype.names)  # type: ignore[index,union-attr]
    ]
    finite = all(np.isfinite(cloud[name]).all() for name in "xyz")
    step = cloud.dtype.itemsize
    return message_type("sensor_msgs/msg/PointCloud2")(
        header=make_header(stamp),
        height=1,
        width=len(cloud),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(cloud),
        data=np.frombuffer(cloud.tobytes(), np.uint8),
        is_dense=bool(finite),
    )


def _color(cloud: NDArray[Any]) -> NDArray[np.uint8] | None:
    if "rgb" not in (cloud.dtype.names or ()):
        return None
    packed = np.ascontiguousarray(cloud["rgb"])
    packed = packed.astype(packed.dtype.newbyteorder("=")).view(np.uint32)
    return np.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)


def _some(values: NDArray[Any]) -> str:
    listed = ", ".join(str(v) for v in np.asarray(values).ravel()[:_MAX_DAMAGE_LISTED].tolist())
    return listed + (", ..." if np.size(values) > _MAX_DAMAGE_LISTED else "")

"""Messages of the planner node <-> plain values; the other conversions are in convert.py."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Transform, Vector3
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from pred_core.bag.clouds import cloud_array
from pred_core.bag.wire import GOAL_POINTS, check_frame
from pred_core.plan.plan import Plan
from pred_core.types import Array
from pred_ros import convert

_XYZ = {"x": "f4", "y": "f4", "z": "f4"}


def cloud_to_goal(cloud: PointCloud2) -> Array:
    """Points (Q, 3) [m] of goal/points. Raises: BagError for another frame or layout."""
    check_frame(cloud, GOAL_POINTS)
    table = cloud_array(cloud, _XYZ, GOAL_POINTS)
    return np.stack([table[axis] for axis in "xyz"], axis=-1).astype(np.float64)


def goal_to_cloud(stamp: int, points: Array) -> PointCloud2:
    """goal/points of points (Q, 3) [m] world."""
    return convert.make_cloud(stamp, _XYZ, dict(zip("xyz", points.T, strict=True)))


def plan_to_message(plan: Plan, spacing: float) -> MultiDOFJointTrajectory:
    """What is sent of a plan, a point every `spacing` [s]; joint names gripper0, gripper1, ..."""
    times, position, rotation = plan.points(spacing)
    points = []
    for t, places, turns in zip(times.tolist(), position.tolist(), rotation.tolist(), strict=True):
        poses = [
            Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(w=w, x=i, y=j, z=k))
            for (x, y, z), (w, i, j, k) in zip(places, turns, strict=True)
        ]
        point = MultiDOFJointTrajectoryPoint(transforms=poses)
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(t * 1e9), 10**9)
        points.append(point)
    names = [f"gripper{g}" for g in range(position.shape[1])]
    return MultiDOFJointTrajectory(header=convert.header_at(plan.start), joint_names=names, points=points)


def plan_to_markers(stamp: int, ways: list[Array], costs: list[float], best: Array) -> MarkerArray:
    """The gripper's ways of sampled motions, each (T, 3) [m], cheap ones opaque, and of the plan."""
    order = np.argsort(np.argsort(costs))
    fade = [float(0.8 * (1.0 - rank / max(len(order), 1)) + 0.05) for rank in order]
    markers = [
        _line(stamp, "samples", i, way, ColorRGBA(r=0.0, g=0.45, b=0.7, a=a), 0.001)
        for i, (way, a) in enumerate(zip(ways, fade, strict=True))
    ]
    markers.append(_line(stamp, "plan", 0, best, ColorRGBA(r=0.84, g=0.37, b=0.0, a=1.0), 0.004))
    clear = Marker(header=convert.header_at(stamp), ns="samples", action=Marker.DELETEALL)
    return MarkerArray(markers=[clear, *markers])


def _line(stamp: int, space: str, index: int, way: Array, color: ColorRGBA, width: float) -> Marker:
    marker = Marker(header=convert.header_at(stamp), ns=space, id=index, type=Marker.LINE_STRIP, color=color)
    marker.scale.x = width
    marker.pose.orientation.w = 1.0
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in way.tolist()]
    return marker

"""Every quality-of-service profile in one place. Reliable writers serve reliable and best-effort readers alike.

Live readers of points keep the newest few. A scored replay must lose nothing, however slow its reader: with
`overload: queue` the predictor reads the complete profile, as the evaluator does. Writers are complete, because a
writer that keeps fewer messages than a reader asks for loses them; their memory follows what is not yet taken.
"""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

LIVE_DEPTH = 5
LIVE_POSES = 50  # 0.1 s at 500 Hz: small, and every one of them moves the simulation
PLANS_DEPTH = 10  # 0.2 s at 50 plans a second
# Deep enough for the longest backlog of a scored replay (20 s at 500 Hz); memory follows what is queued.
COMPLETE_DEPTH = 10_000


def points_live() -> QoSProfile:
    """Readers that want the newest points: the predictor with `overload: newest`. A slow one loses the oldest."""
    return _profile(LIVE_DEPTH, DurabilityPolicy.VOLATILE)


def poses_live() -> QoSProfile:
    """Live readers of poses and flags: deeper than of points, but never seconds behind them."""
    return _profile(LIVE_POSES, DurabilityPolicy.VOLATILE)


def points_complete() -> QoSProfile:
    """Writers of points and poses, and readers that must not lose one (a queueing predictor, the evaluator)."""
    return _profile(COMPLETE_DEPTH, DurabilityPolicy.VOLATILE)


def command() -> QoSProfile:
    """Commands: only the newest counts; the reader's watchdog judges its age."""
    return _profile(1, DurabilityPolicy.VOLATILE)


def plans() -> QoSProfile:
    """Plans: each continues the one before, so a reader that was busy for a moment must not miss one."""
    return _profile(PLANS_DEPTH, DurabilityPolicy.VOLATILE)


def images() -> QoSProfile:
    """Pictures, as camera drivers send them: the newest few, none twice."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=LIVE_DEPTH,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def latched(depth: int = 1) -> QoSProfile:
    """What a late reader must still get: gripper/closed, episode marks, camera poses, goals."""
    return _profile(depth, DurabilityPolicy.TRANSIENT_LOCAL)


def is_latched(node: Node, topic: str) -> bool:
    """Whether somebody who writes a topic keeps its last message for late readers; only they can be read so."""
    writers = node.get_publishers_info_by_topic(topic)
    return any(w.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for w in writers)


def _profile(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )

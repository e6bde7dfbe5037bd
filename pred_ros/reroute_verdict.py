"""What a run comes to in numbers: success, distances against the truth, seconds per replan, and what a fault did."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pred_core.metrics.chamfer import chamfer_two_sided
from pred_core.types import Array
from pred_ros.reroute_faults import Fault
from pred_ros.reroute_record import NS, Record

COLLISIONS = "collisions: "  # before a pair, in the plant's diagnostics
NAMED_WITHIN = 10.0  # [s] after the last step of a fault
OVER = 1.1  # times the arm's limit that a measured speed may show: it is a difference of measurements


@dataclass(frozen=True)
class FaultVerdict:
    """What the arm did after a fault, and who said what."""

    name: str
    begin: float  # [s] after the arm was enabled
    named: str  # the first fitting line of the diagnostics, '' if there is none
    named_after: float | None  # [s]
    stopped_after: float | None  # [s] until the gripper stood still for the first time
    speed: float  # [m/s] the largest of the gripper afterwards
    collisions: int  # of the gripper with slot and table, afterwards
    safe: bool  # no faster than the arm's limit, nothing hit
    plans_after: int  # plans sent more than a second after the last step


@dataclass(frozen=True)
class Verdict:
    """Distances in metres, times in seconds."""

    success: bool
    seconds: float  # [s] of the cell's time, from enabling the arm to the end
    factor: float  # times real time
    chamfer: dict[str, float]  # to the goal, of the truth: at the begin, at the end, least
    tracker_error: dict[str, float]  # against the truth at the same stamp
    state_error: dict[str, float]
    replans: int
    replan: dict[str, float]  # [s] on the wall: median, p90; motions tried (median)
    collisions: dict[str, int]
    fault: FaultVerdict | None

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def judge(record: Record, wall: float, limit: float, fault: Fault | None) -> Verdict:
    """wall [s]: that the cell's time took; limit [m/s]: of the arm's speed."""
    distance = goal_distances(record)[1]
    seconds = record.seconds(record.now)
    planning = np.array([row[1:] for row in record.planning], float).reshape(-1, 2)
    return Verdict(
        success=record.success,
        seconds=seconds,
        factor=seconds / max(wall, 1e-9),
        chamfer={
            "begin": float(distance[0]), "end": float(distance[-1]), "least": float(distance.min())
        } if len(distance) else {},
        tracker_error=spread(errors(record, record.tracked)[1]),
        state_error=spread(errors(record, record.states)[1]),
        replans=len(record.plans),
        replan={
            "median": float(np.median(planning[:, 0])),
            "p90": float(np.quantile(planning[:, 0], 0.9)),
            "motions": float(np.median(planning[:, 1])),
        } if len(planning) else {},
        collisions=collisions(record.values.get("plant", {})),
        fault=None if fault is None or record.fault is None else _fault(record, fault, limit),
    )  # fmt: skip


def goal_distances(record: Record) -> tuple[Array, Array]:
    """Times (T,) [s] and two-sided chamfer distances (T,) [m] of the true rope to the goal, from the begin on."""
    rows = [(record.seconds(s), chamfer_two_sided(p, record.goal)) for s, p in record.truth if s >= record.begin]
    table = np.array(rows).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def errors(record: Record, seen: list[tuple[int, Array]]) -> tuple[Array, Array]:
    """Times (T,) [s] and mean distances (T,) [m] of particles from the true rope's same material points.

    Particles are evenly along the rope; the truth is taken at their stamp, or between its two neighbours.
    """
    if not record.truth:
        return np.zeros(0), np.zeros(0)
    stamps = np.array([s for s, _ in record.truth])
    rope = np.stack([p for _, p in record.truth])
    rows = []
    for stamp, points in seen:
        k = int(np.searchsorted(stamps, stamp))
        if stamp < record.begin or k == len(stamps) or (k == 0 and stamp != stamps[0]):
            continue
        before = max(k - 1, 0) if stamps[k] != stamp else k
        share = 0.0 if before == k else (stamp - stamps[before]) / (stamps[k] - stamps[before])
        true = (1.0 - share) * rope[before] + share * rope[k]
        at = np.linspace(0.0, 1.0, len(points))
        along = np.linspace(0.0, 1.0, rope.shape[1])
        same = np.stack([np.interp(at, along, true[:, axis]) for axis in range(3)], axis=1)
        rows.append((record.seconds(stamp), float(np.linalg.norm(points - same, axis=1).mean())))
    table = np.array(rows).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def spread(values: Array) -> dict[str, float]:
    """Mean, median and largest; empty for nothing."""
    if not len(values):
        return {}
    return {"mean": float(values.mean()), "median": float(np.median(values)), "max": float(values.max())}


def collisions(values: dict[str, str]) -> dict[str, int]:
    """By pair, as the plant's diagnostics counted them."""
    return {k.removeprefix(COLLISIONS): int(v) for k, v in values.items() if k.startswith(COLLISIONS)}


def _fault(record: Record, fault: Fault, limit: float) -> FaultVerdict:
    assert record.fault is not None
    last = max(step.after for step in fault.steps)
    until = record.fault + round((last + NAMED_WITHIN) * NS)
    fitting = [
        said for said in record.said
        if record.fault <= said.stamp <= until
        and any(said.node == node and words in said.message for node, words in fault.named_by)
    ]  # fmt: skip
    named = fitting[0] if fitting else None
    rest = record.rests_from(record.fault)
    speed = record.speed(record.fault, record.now)
    before = collisions(record.values_at_fault)
    after = collisions(record.values.get("plant", {}))
    hits = sum(n - before.get(pair, 0) for pair, n in after.items() if pair.startswith("gripper"))
    later = record.fault + round((last + 1.0) * NS)
    return FaultVerdict(
        name=fault.name,
        begin=record.seconds(record.fault),
        named="" if named is None else f"{named.node}: {named.message}",
        named_after=None if named is None else (named.stamp - record.fault) / NS,
        stopped_after=None if rest is None else (rest - record.fault) / NS,
        speed=speed,
        collisions=hits,
        safe=speed <= OVER * limit and hits == 0,
        plans_after=sum(p.stamp > later for p in record.plans),
    )

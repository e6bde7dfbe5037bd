"""What can go wrong in the loop, on purpose: the actions in order, and what the diagnostics must then say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

GONE = "says nothing any more: it has ended, or hangs"  # what the watch says of a node without diagnostics
CAMERAS = ("cam0", "cam1", "cam2", "cam3")


class Hands(Protocol):
    """What a fault can touch."""

    def break_cameras(self, dead: str, bumped: str) -> None:
        """Exactly these cameras, separated by commas, are dead or bumped from now on."""

    def call(self, service: str) -> None:
        """Call a Trigger service."""

    def kill(self, node: str) -> None:
        """SIGKILL: no farewell."""

    def restart(self, node: str) -> None:
        """Start a killed node again, with the same parameters, and enable it as it was."""


@dataclass(frozen=True)
class Step:
    """One thing that happens, `after` [s] of the cell's time from the begin of the fault."""

    after: float
    text: str
    do: Callable[[Hands], None]


@dataclass(frozen=True)
class Fault:
    """A fault, and the node and words of the diagnostics that must name it."""

    name: str
    help: str
    steps: tuple[Step, ...]
    named_by: tuple[tuple[str, str], ...]  # any of these pairs (node, words)
    reachable: bool = True  # whether the task can still be done


def _dead(cameras: str) -> Callable[[Hands], None]:
    return lambda hands: hands.break_cameras(cameras, "")


FAULTS: dict[str, Fault] = {
    f.name: f
    for f in (
        Fault(
            "one_camera",
            "cam0 delivers nothing any more",
            (Step(0.0, "cam0 dies", _dead("cam0")),),
            (("tracker", "without cam0"),),
        ),
        Fault(
            "two_cameras",
            "cam0 and cam2 deliver nothing any more",
            (Step(0.0, "cam0 and cam2 die", _dead("cam0,cam2")),),
            (("tracker", "without cam0, cam2"),),
        ),
        Fault(
            "silence",
            "no camera delivers anything for 300 ms",
            (
                Step(0.0, "all cameras fall silent", _dead(",".join(CAMERAS))),
                Step(0.3, "all cameras are back", _dead("")),
            ),
            (("tracker", "no pictures of any camera"),),
        ),
        Fault(
            "tracker_killed",
            "the tracker is killed, and started again 3 s later",
            (
                Step(0.0, "the tracker is killed", lambda hands: hands.kill("tracker")),
                Step(3.0, "the tracker is started again", lambda hands: hands.restart("tracker")),
            ),
            (("predictor", "tracks for"), ("planner", "state/points")),
        ),
        Fault(
            "predictor_killed",
            "the predictor is killed, and started again 4 s later",
            (
                Step(0.0, "the predictor is killed", lambda hands: hands.kill("predictor")),
                Step(4.0, "the predictor is started again", lambda hands: hands.restart("predictor")),
            ),
            (("planner", "state/points stopped"),),
        ),
        Fault(
            "planner_killed",
            "the planner is killed, and started again 4 s later",
            (
                Step(0.0, "the planner is killed", lambda hands: hands.kill("planner")),
                Step(4.0, "the planner is started again", lambda hands: hands.restart("planner")),
            ),
            (("planner", GONE),),
        ),
        Fault(
            "bumped_camera",
            "cam1 is moved by 5 mm and 1 degree and still reports its old pose",
            (Step(0.0, "cam1 is bumped", lambda hands: hands.break_cameras("", "cam1")),),
            (("tracker", "cam1 sees the object"),),
        ),
        Fault(
            "slip",
            "the rope slips out of the jaws",
            (Step(0.0, "the rope slips out of the jaws", lambda hands: hands.call("/plant/slip")),),
            (("tracker", "slipped out"), ("predictor", "not in the gripper")),
            reachable=False,
        ),
    )
}

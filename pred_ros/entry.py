"""Entry points of nodes and commands: Ctrl-C while their modules load, which takes seconds, leaves no traceback.

The process ends within the signal's handler: an exception would come out of an extension module as another one.
"""

from __future__ import annotations

import importlib
import os
import signal
from collections.abc import Callable

NODE_ENDED, COMMAND_ENDED = 0, 130  # exit codes of what a person has interrupted


def _entry(module: str, code: int) -> Callable[[], int]:
    def main() -> int:
        before = signal.signal(signal.SIGINT, lambda *_: os._exit(code))
        loaded = importlib.import_module(module)
        signal.signal(signal.SIGINT, before)
        return int(loaded.main())

    return main


player = _entry("pred_ros.player_node", NODE_ENDED)
plant = _entry("pred_ros.plant_node", NODE_ENDED)
tracker = _entry("pred_ros.tracker_node", NODE_ENDED)
predictor = _entry("pred_ros.predictor_node", NODE_ENDED)
evaluator = _entry("pred_ros.evaluator_node", NODE_ENDED)
planner = _entry("pred_ros.planner_node", NODE_ENDED)
arm = _entry("pred_ros.arm_node", NODE_ENDED)
pred_replay = _entry("pred_ros.replay", COMMAND_ENDED)
pred_bringup = _entry("pred_ros.bringup", NODE_ENDED)
pred_reroute = _entry("pred_ros.reroute", COMMAND_ENDED)
pred_motion = _entry("pred_ros.motion", COMMAND_ENDED)

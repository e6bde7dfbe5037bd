"""Predictor nodes whose Dynamics is known by hand, and the parameters most tests of them share."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from pathlib import Path

from live_world import PERIOD, Straight
from ros_bench import Bench, bench_of

from pred_core.types import Grip, State
from pred_ros.predictor_node import PredictorNode


class StraightPredictor(PredictorNode):
    """The node with a Dynamics whose result is known by hand."""

    MAKE_DYNAMICS = staticmethod(lambda twin: Straight())


class SlowPredictor(PredictorNode):
    """The same, where each step takes twice the period."""

    MAKE_DYNAMICS = staticmethod(lambda twin: _Slow())


class _Slow(Straight):
    def step(self, state: State, grip: Grip) -> State:
        time.sleep(2 * PERIOD)
        return super().step(state, grip)


def predictor_bench(
    twin: Path, node: type[PredictorNode] = StraightPredictor, **more: str
) -> AbstractContextManager[Bench]:
    """A predictor that holds particle 0 and keeps all messages; `more`: other parameters."""
    return bench_of(node, {"twin": str(twin), "held": "'0:0'", "overload": "queue", **more})

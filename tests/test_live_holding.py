"""An open gripper holds nothing: neither at the start of a run, nor after it has opened."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_live_following import BEGIN, TICK, TWIN, follower, hanging, seen

from pred_core.bag.grippers import PoseFrame
from pred_core.live.holding import held_at_start
from pred_core.live.prediction import Predictor
from pred_core.live.prediction_records import Prediction, Rules
from pred_core.live.run import Run
from pred_core.pred import load_dynamics
from pred_core.types import Grip

IDS = np.array([7, 8, 9], np.uint32)
PLACE = np.array([[0.0, 0.0, 0.3], [0.1, 0.0, 0.3], [0.2, 0.0, 0.3]])  # [m]


def grip(*closed: bool) -> Grip:
    """Gripper 0 at the first particle, gripper 1 at the last."""
    count = len(closed)
    place = torch.as_tensor(PLACE[[0, 2]][:count], dtype=torch.float32)
    return Grip(place, torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4), torch.tensor(closed))


@pytest.mark.parametrize("told", [{7: 0, 9: 1}, None])
def test_only_closed_grippers_hold_at_a_start(told: dict[int, int] | None) -> None:
    def held(now: Grip, before: Grip | None = None) -> list[int]:
        return held_at_start(IDS, told, PLACE, before or now, now).tolist()

    assert held(grip(True, True)) == [0, -1, 1]
    assert held(grip(False, True)) == [-1, -1, 1]
    assert held(grip(False, False)) == [-1, -1, -1]
    assert held(grip(False, True), grip(True, True)) == [-1, -1, 1], "opened between the first frame and the start"


def run(one: Run, closed: bool, ticks: int = 60) -> list[Prediction]:
    """Poses at every tick, complete tracks once a period."""
    given: list[Prediction] = []
    with torch.no_grad():
        for tick in range(ticks):
            stamp = BEGIN + tick * TICK
            place, turn = np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0, 0.0]])
            one.add_pose(PoseFrame(stamp, place, turn), np.array([closed]))
            if tick % 5 == 0:
                one.add_points(seen(stamp))
            given += list(one.advance())
    return given


@pytest.mark.parametrize("closed", [False, True])
def test_the_state_of_an_estimate_started_with_an_open_gripper_is_free(closed: bool) -> None:
    """The twin knows what is held; its rope falls all the same if the jaws are open."""
    given = run(follower(), closed)
    assert given and (given[0].state.held >= 0).sum() == (2 if closed else 0)


def test_the_model_alone_falls_from_an_open_gripper() -> None:
    period = round(TWIN.meta.period * 1e9)
    heights = {}
    for closed in (False, True):
        one = Predictor(load_dynamics(TWIN), TWIN.body.id, {0: 0, 1: 0}, Rules())
        given: list[Prediction] = []
        with torch.no_grad():
            for k in range(12):
                place, turn = np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0, 0.0]])
                one.add_pose(PoseFrame(BEGIN + k * period, place, turn), np.array([closed]))
                one.add_points(seen(BEGIN + k * period))
                given += list(one.advance())
        heights[closed] = hanging()[:, 2].mean() - float(given[2].state.position[:, 2].mean())
    fall = 0.5 * 9.81 * (3 * TWIN.meta.period) ** 2  # 49 mm of the middle of mass, before the end touches the table
    assert heights[False] == pytest.approx(fall, rel=0.05)  # the substeps of the simulator are finite
    assert heights[True] < 0.1 * fall

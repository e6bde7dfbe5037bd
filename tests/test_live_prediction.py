"""The predictor's core without any process: message by message it equals the offline batch, network included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pred_core.bag.clouds import PointFrame, read_tracker_points
from pred_core.bag.dataset import load_dataset
from pred_core.bag.grippers import PoseFrame, read_gripper_closed, read_gripper_pose
from pred_core.bag.reader import open_bag
from pred_core.bag.wire import GRIPPER_POSE, REQUIRED, TRACKER_POINTS
from pred_core.evaluate.protocol import predict
from pred_core.live.prediction import Predictor
from pred_core.live.prediction_records import Rules
from pred_core.pred import load_dynamics
from pred_core.residual.config import ResidualConfig
from pred_core.residual.network import build_network
from pred_core.springmass.topology import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Episode, Physics, Scene

SAMPLE = Path(__file__).parents[1] / "bags" / "sample_cable"


def pred_twin(episode: Episode) -> Twin:
    """A twin with a residual network whose weights are random: it predicts badly, but it has a memory."""
    physics = Physics(stiffness=50.0, damping=0.05, connection_threshold=0.1, max_springs=4)
    body = build_body("line", episode.position[0], 0.05, physics, id=episode.tracks.id)
    network, generator = build_network(ResidualConfig(), 3), torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    meta = TwinMeta(object=episode.object, period=episode.period)
    return Twin(meta, body, physics, Scene(gravity=episode.gravity), residual=network.weights())


def test_message_by_message_equals_the_offline_batch_with_the_network() -> None:
    dataset = load_dataset(SAMPLE)
    entry = dataset.select("test")[0]
    episode = dataset.read(entry)
    twin = pred_twin(episode)
    frames = 60
    predictor = Predictor(load_dynamics(twin), twin.body.id, dataset.held, Rules())
    closed = np.array([True, True])
    live: dict[int, np.ndarray] = {}
    with torch.no_grad():
        for message in open_bag(SAMPLE / entry.bag).read_messages(REQUIRED):
            decoded = message.decode()
            if message.topic == TRACKER_POINTS:
                predictor.add_points(read_tracker_points(decoded, message.where))
            elif message.topic == GRIPPER_POSE:
                predictor.add_pose(read_gripper_pose(decoded, message.where), closed)
            else:
                closed = read_gripper_closed(decoded, message.where)
            for prediction in predictor.advance():
                live[prediction.stamp] = prediction.state.position.double().numpy()
            if len(live) >= frames:
                break
    (offline,) = predict(load_dynamics(twin), [episode])
    assert list(live) == episode.stamps[2 : 2 + frames].tolist()
    difference = np.abs(np.stack(list(live.values())) - offline[:frames]).max()
    # Same arithmetic in another batch shape; a float32 at 1 m has 1e-7 m, and the motion amplifies it little in 0.6 s.
    assert difference < 2e-5
    base = Predictor(load_dynamics(twin.replace(residual=None)), twin.body.id, dataset.held, Rules())
    assert base.running is False
    (without,) = predict(load_dynamics(twin.replace(residual=None)), [episode])
    assert np.abs(without[:frames] - offline[:frames]).max() > 1e-4, "the network takes part"


@pytest.mark.parametrize("rate", [75.0, 20.0, 18.0, 12.0, 125.0])
def test_poses_at_another_rate_than_the_twin_steps_give_the_same_motion(rate: float) -> None:
    """A step lasts its period, whatever comes how often: 15 Hz of tracks and steps, a gripper led at constant speed."""
    twin = Twin.load(Path(__file__).parents[1] / "config" / "twins" / "cell_rope")
    same, other = (led(twin, pace, 1.6) for pace in (15.0, rate))
    assert len(same) >= 20
    common = [(same[k], other[k]) for k in same if k in other]
    assert len(common) >= 19, "the last step waits for a pose beyond it"
    # Poses in between lie on the same straight line: what is left is float32.
    assert max(float(np.abs(a - b).max()) for a, b in common) < 2e-5


def led(twin: Twin, rate: float, seconds: float) -> dict[int, np.ndarray]:
    """Predicted positions by step, of a straight rope led along +x at 0.3 m/s with poses at `rate` [Hz]."""
    begin, speed = 3_000_000_000, np.array([0.3, 0.0, 0.0])
    place = np.zeros((twin.body.count, 3))
    place[:, 2] = 1.0 - np.concatenate(([0.0], np.cumsum(twin.body.rest_length)))
    predictor = Predictor(load_dynamics(twin), twin.body.id, {0: 0}, Rules())
    period = twin.meta.period
    arrivals = [(round(k / rate * 1e9), 0) for k in range(round(seconds * rate) + 1)]
    arrivals += [(round(k * period * 1e9), 1) for k in range(round(seconds / period) + 1)]
    found: dict[int, np.ndarray] = {}
    with torch.no_grad():
        for stamp, is_track in sorted(arrivals):
            at = speed * (stamp * 1e-9)
            if is_track:
                seen = np.ones(len(place), np.float32)
                predictor.add_points(PointFrame(begin + stamp, place + at, twin.body.id, seen, None))
            else:
                grip = PoseFrame(begin + stamp, (at + [0.0, 0.0, 1.0])[None], np.array([[1.0, 0.0, 0.0, 0.0]]))
                predictor.add_pose(grip, np.array([True]))
            for prediction in predictor.advance():
                step = round((prediction.stamp - begin) * 1e-9 / period)
                assert abs(prediction.stamp - begin - step * period * 1e9) < 1e6, "on the grid"
                found[step] = prediction.state.position.double().numpy()
    return found

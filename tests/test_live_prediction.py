"""The predictor's core without any process: message by message it equals the offline batch, network included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pred_core.bag.clouds import read_tracker_points
from pred_core.bag.dataset import load_dataset
from pred_core.bag.grippers import read_gripper_closed, read_gripper_pose
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

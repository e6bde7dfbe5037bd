"""The evaluator node, the player's start-up and the shell they share: scores and answers to bad input."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from live_world import COUNT, START, STEP, make_twin, points
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParametersAtomically
from ros_bench import Bench, bench_of, own_domain
from std_msgs.msg import String

from pred_core.errors import BagError
from pred_core.live import marks
from pred_core.twin import Extension, ResidualWeights, Twin
from pred_core.types import State
from pred_ros import bringup, convert, qos, shell
from pred_ros.arm_node import ArmNode
from pred_ros.evaluator_node import EvaluatorNode
from pred_ros.live_report import stage_name
from pred_ros.node_parameters import check_parameters, config_class
from pred_ros.planner_node import PlannerNode
from pred_ros.plant_node import PlantNode
from pred_ros.player_node import PlayerNode
from pred_ros.predictor_node import PredictorNode
from pred_ros.processes import NODES, Children
from pred_ros.tracker_node import TrackerNode

ROOT = Path(__file__).parents[1]
ERROR = DiagnosticStatus.ERROR
IDS = np.arange(COUNT, dtype=np.uint32)


def prediction(frame: int, off: float = 0.0) -> tuple[int, State]:
    """The measured place of frame k, moved by `off` [m] along y."""
    position = torch.as_tensor(points(frame).position, dtype=torch.float32)
    position[:, 1] += off
    return START + frame * STEP, State(position, torch.zeros(COUNT, 3), torch.full((COUNT,), -1, dtype=torch.int32))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with bench_of(EvaluatorNode, {"out": str(tmp_path / "out"), "patience": "0.5"}) as made:
        yield made


def publish(bench: Bench, frames: int, skip: int | None = None) -> None:
    """`frames` measured frames and predictions 3 mm off from frame 2 on, without the one of frame `skip`."""
    for k in range(frames):
        bench.points_out.publish(convert.points_to_cloud(points(k)))
        if k >= 2 and k != skip:
            stamp, state = prediction(k, 0.003)
            bench.prediction_out.publish(convert.state_to_cloud(stamp, IDS, state))


def mark_out(bench: Bench, *these: marks.Mark) -> None:
    """Episode marks, after the data they describe: readers must not depend on the order."""
    publisher = bench.world.create_publisher(String, marks.TOPIC, qos.latched(10))
    bench.until(lambda: publisher.get_subscription_count() == 1, "the evaluator listens to marks")
    for mark in these:
        publisher.publish(String(data=marks.encode(mark)))


def test_score_is_the_distance_put_in(bench: Bench, tmp_path: Path) -> None:
    publish(bench, 12)
    mark_out(bench, marks.EpisodeMark("one", 0, 1, START, 12, split="test"), marks.EndMark(1))
    bench.until(lambda: bench.node.exit_code is not None, "the score is written")
    assert bench.node.exit_code == 0
    written = json.loads((tmp_path / "out" / "metrics.json").read_text())
    metrics = written["entries"][0]["metrics"]
    # 3 mm along one of three coordinates: mde 3 mm, coordinate_l1 1 mm; float32 on the wire.
    assert metrics["mde"]["all_steps"]["mean"] == pytest.approx(0.003, abs=1e-7)
    assert metrics["coordinate_l1"]["all_steps"]["mean"] == pytest.approx(0.001, abs=1e-7)
    assert written["frames"] == {"announced": 12, "lost": 0}
    assert "Live prediction, scored" in (tmp_path / "out" / "report.html").read_text()


def test_a_lost_prediction_is_counted_and_not_averaged(bench: Bench, tmp_path: Path) -> None:
    publish(bench, 12, skip=7)
    mark_out(bench, marks.EpisodeMark("one", 0, 1, START, 12), marks.EndMark(1))
    bench.until(lambda: bench.node.exit_code is not None, "the score is written after `patience`")
    written = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert written["frames"] == {"announced": 12, "lost": 1}
    assert written["entries"][0]["metrics"]["mde"]["all_steps"]["mean"] == pytest.approx(0.003, abs=1e-7)


def test_two_episodes_are_cut_at_the_marks(bench: Bench, tmp_path: Path) -> None:
    publish(bench, 20)
    first = marks.EpisodeMark("a", 0, 2, START, 10, split="test")
    second = marks.EpisodeMark("b", 1, 2, START + 10 * STEP, 10, split="test")
    mark_out(bench, second, first, marks.EndMark(2))
    bench.until(lambda: bench.node.exit_code is not None, "the score is written")
    written = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(written["entries"][0]["metrics"]["mde"]["all_steps"]["per_episode"]) == {"a", "b"}


def test_nothing_predicted_is_an_error(bench: Bench, capsys: pytest.CaptureFixture) -> None:
    for k in range(5):
        bench.points_out.publish(convert.points_to_cloud(points(k)))
    mark_out(bench, marks.EpisodeMark("one", 0, 1, START, 5), marks.EndMark(1))
    bench.until(lambda: bench.node.exit_code is not None, "the evaluator gives up")
    assert bench.node.exit_code == 2
    assert "no prediction matches a measured frame" in capsys.readouterr().err


def test_bad_messages_are_refused_by_name(bench: Bench) -> None:
    stamp, state = prediction(3)
    cloud = convert.state_to_cloud(stamp, IDS, state)
    cloud.header.frame_id = "base_link"
    bench.prediction_out.publish(cloud)
    bench.until(lambda: bench.says(ERROR, "prediction/points", "base_link"), "an error about the frame")
    bad = points(0)
    bad.position[0] = np.inf
    bench.points_out.publish(convert.points_to_cloud(bad))
    bench.until(lambda: bench.says(ERROR, "ids 0 are not finite"), "an error about the points")
    for k in (5, 4):
        bench.points_out.publish(convert.points_to_cloud(points(k)))
    bench.until(lambda: bench.says(ERROR, "tracker/points: time runs backwards"), "an error about the time")
    mark = bench.world.create_publisher(String, marks.TOPIC, qos.latched(10))
    mark.publish(String(data="{}"))
    bench.until(lambda: bench.says(ERROR, "player/episode: event"), "an error about the mark")


def test_a_state_that_is_not_finite_never_becomes_a_message() -> None:
    stamp, state = prediction(3)
    with pytest.raises(ValueError, match="not finite"):
        convert.state_to_cloud(stamp, IDS, state.replace(position=state.position * torch.nan))


def test_clouds_survive_the_wire_bit_for_bit() -> None:
    stamp, state = prediction(5, 0.0012345)
    back_stamp, ids, back = convert.cloud_to_state(convert.state_to_cloud(stamp, IDS, state), "state/points")
    assert back_stamp == stamp and ids.tolist() == IDS.tolist()
    assert torch.equal(back.position, state.position) and torch.equal(back.held, state.held)
    frame = points(3)
    again = convert.cloud_to_points(convert.points_to_cloud(frame))
    assert np.array_equal(again.position, frame.position.astype(np.float32)) and again.stamp == frame.stamp


def test_a_state_in_millimetres_is_refused_and_a_prediction_astray_is_scored() -> None:
    stamp, state = prediction(5)
    cloud = convert.state_to_cloud(stamp, IDS, state.replace(position=1e3 * state.position))
    with pytest.raises(BagError, match="state/points: implausible extent, are these millimetres?"):
        convert.cloud_to_state(cloud, "state/points")
    assert torch.equal(convert.cloud_to_state(cloud, "prediction/points")[2].position, 1e3 * state.position)


def run_node(node: type[shell.Shell], *parameters: str) -> int:
    """A node's main with parameters NAME:=VALUE."""
    arguments = ["--ros-args"]
    for parameter in parameters:
        arguments += ["-p", parameter]
    with own_domain():
        return shell.run(node, arguments)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--ros-args", "--params-file", "nofile.yaml"], "nofile.yaml"),
        (["--ros-args", "-p", "length"], "-p length"),
        (["--length", "0.7", "--ros-args", "-p", "rate:=50.0"], "arguments that no node has; got --length 0.7"),
    ],
)
def test_arguments_that_are_no_parameters(
    arguments: list[str], word: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with own_domain():
        assert shell.run(ArmNode, arguments) == 2
    line = capfd.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("arm: ") and word in line and "arm --ros-args -p NAME:=VALUE" in line


STARTS = [
    (PlayerNode, (), "parameter 'bag' is empty"),
    (PlayerNode, ("bag:=/no/such/bag.mcap",), "no such bag"),
    (PlayerNode, (f"bag:={ROOT / 'LICENSE'}",), "not a bag"),
    (PlayerNode, (f"bag:={ROOT / 'bags/sample_cable'}", "episodes:=ep999"), "no episode 'ep999'"),
    (PlayerNode, (f"bag:={ROOT / 'bags/sample_cable'}", "factor:=0.0"), "factor; got 0.0 x real time; allowed: 0.01"),
    (PlayerNode, (f"bag:={ROOT / 'bags/sample_cable'}", "factr:=2.0"), "unknown key 'factr'. did you mean 'factor'?"),
    (PlayerNode, (f"bag:={ROOT / 'bags/sample_cable'}", "stamps:=now", "factor:=2.0"), "factor 1"),
    (PlayerNode, (f"bag:={ROOT / 'bags/sample_cable'}", "patience:=0.2"), "no reader within 0.2 s"),
    (PredictorNode, (), "parameter 'twin' is empty"),
    (PredictorNode, ("twin:=/no/such/twin",), "/no/such/twin"),
    (PredictorNode, ("twin:=x", "horizon:=9.0"), "horizon; got 9.0 s; allowed: 0.0 to 5.0 s"),
    (PredictorNode, ("twin:=x", "correct:=sometimes"), "allowed: none, tracks"),
    (PredictorNode, ("twin:=x", "threads:=1.5"), "threads; got 1.5 (float); allowed: int"),
    (EvaluatorNode, ("tolerance:=-1.0",), "tolerance; got -1.0 s"),
    (EvaluatorNode, ("out:=/proc/nowhere",), "the folder cannot be made"),
]


@pytest.mark.parametrize(("node", "parameters", "expected"), STARTS)
def test_a_bad_start_is_one_clear_line_and_code_2(
    node: type[shell.Shell], parameters: tuple[str, ...], expected: str, capfd: pytest.CaptureFixture
) -> None:
    assert run_node(node, *parameters) == 2
    lines = [x for x in capfd.readouterr().err.splitlines() if x.startswith(f"{node.NAME}: ")]
    assert len(lines) == 1 and expected.lower() in lines[0].lower()


def test_held_that_does_not_fit_the_twin_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    twin = make_twin(tmp_path / "twin")
    assert run_node(PredictorNode, f"twin:={twin}", "held:='77:0'") == 2
    assert "particles the twin does not have; got [77]" in capfd.readouterr().err
    assert run_node(PredictorNode, f"twin:={twin}", "held:='zero'") == 2
    assert "pairs like '0:0 1:1 11:2'" in capfd.readouterr().err
    assert run_node(PredictorNode, f"twin:={twin}", "held:='0:0 0:1'") == 2
    assert "parameter 'held' names a particle twice; got '0:0 0:1'" in capfd.readouterr().err


def test_parameters_change_all_or_none(bench: Bench) -> None:
    client = bench.world.create_client(SetParametersAtomically, "/evaluator/set_parameters_atomically")
    bench.until(client.service_is_ready, "the service")

    def value(name: str, number: float) -> ParameterMsg:
        return ParameterMsg(name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=number))

    request = SetParametersAtomically.Request(parameters=[value("patience", 3.0), value("tolerance", 5.0)])
    answer = client.call_async(request)
    bench.until(answer.done, "an answer")
    assert not answer.result().result.successful
    assert bench.node.config.patience == 0.5
    request = SetParametersAtomically.Request(parameters=[value("patience", 3.0), value("tolerance", 0.5)])
    answer = client.call_async(request)
    bench.until(answer.done, "an answer")
    assert answer.result().result.successful
    assert (bench.node.config.patience, bench.node.config.tolerance) == (3.0, 0.5)


def test_descriptors_carry_unit_and_range(bench: Bench) -> None:
    client = bench.world.create_client(DescribeParameters, "/evaluator/describe_parameters")
    bench.until(client.service_is_ready, "the service")
    answer = client.call_async(DescribeParameters.Request(names=["patience"]))
    bench.until(answer.done, "an answer")
    descriptor = answer.result().descriptors[0]
    assert "[s]" in descriptor.description
    bounds = descriptor.floating_point_range[0]
    assert (bounds.from_value, bounds.to_value) == (0.1, 600.0)


@pytest.mark.parametrize("file", sorted((ROOT / "config" / "nodes").glob("*.yaml")), ids=lambda p: p.name)
def test_shipped_parameter_files_fit_the_nodes(file: Path) -> None:
    nodes = bringup.read_nodes(file)
    check_parameters(nodes)
    with pytest.raises(ValueError, match="unknown key 'fctor'"):
        check_parameters({**nodes, next(iter(nodes)): {"fctor": 1.0}})
    with pytest.raises(ValueError, match="use_sim_time; got 'yes'; allowed: true, false"):
        check_parameters({**nodes, next(iter(nodes)): {"use_sim_time": "yes"}})


def test_every_node_has_parameters_of_its_own() -> None:
    nodes = (PlayerNode, PredictorNode, EvaluatorNode, ArmNode, TrackerNode, PlannerNode, PlantNode)
    assert {n: config_class(n) for n in NODES} == {c.NAME: c.CONFIG for c in nodes}


def test_bringup_refuses_unknown_nodes_and_malformed_overrides(tmp_path: Path) -> None:
    file = tmp_path / "nodes.yaml"
    file.write_text("predicter:\n  ros__parameters: {}\n")
    with pytest.raises(ValueError, match="did you mean 'predictor'"):
        bringup.read_nodes(file)
    file.write_text("predictor:\n  ros__parameters: {twin: x}\n")
    with pytest.raises(ValueError, match="NODE.PARAMETER=VALUE"):
        bringup.read_nodes(file, ["player.bag=y"])
    assert bringup.read_nodes(file, ["predictor.horizon=0.5"])["predictor"] == {"twin": "x", "horizon": 0.5}


@pytest.mark.parametrize("codes", [(3,), (0, 3), (3, 0)], ids=str)
def test_bringup_returns_the_code_of_a_node_that_failed(
    codes: tuple[int, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    def ends(node: str, parameters: dict) -> list[str]:
        return [sys.executable, "-c", f"import sys; print('why'); sys.exit({parameters['code']})"]

    monkeypatch.setattr(bringup, "node_command", ends)
    # No call of poll before all have ended: what the last one says must be seen all the same.
    start = Children.start
    monkeypatch.setattr(Children, "start", lambda *args: start(*args).wait())
    with kept_signals():
        assert bringup.run({f"n{k}": {"code": code} for k, code in enumerate(codes)}, None, tmp_path) == 3
    assert f"n{codes.index(3)} ended: why" in capsys.readouterr().err


def test_bringup_returns_0_when_all_end_well(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bringup, "node_command", lambda node, _: [sys.executable, "-c", "pass"])
    with kept_signals():
        assert bringup.run({"a": {}, "b": {}}, None, tmp_path) == 0


@contextmanager
def kept_signals() -> Iterator[None]:
    """Bringup takes the signals of its process; a test gives them back."""
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_the_model_is_named_after_the_stage_of_its_twin(tmp_path: Path) -> None:
    twin = Twin.load(make_twin(tmp_path / "twin"))
    assert stage_name(twin) == "spring-mass"
    extended = twin.replace(extensions=(Extension("drag_linear", 1, {"coefficient": (0.1,)}),))
    assert stage_name(extended) == "extended"
    assert stage_name(extended.replace(residual=ResidualWeights({}, {"w": torch.zeros(1)}))) == "pred"


def test_nothing_of_a_test_stays_initialised() -> None:
    assert not rclpy.ok()

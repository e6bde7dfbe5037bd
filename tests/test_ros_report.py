"""What a node says at once: each kind of line, not each number in it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from live_world import make_twin
from ros_bench import bench_of

from pred_ros import shell
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.predictor_node import PredictorNode


def test_lines_that_differ_in_numbers_only_are_no_flood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A message refused 75 times a second was logged and published 75 times."""
    logged: list[str] = []
    published: list[str] = []
    monkeypatch.setattr(PredictorNode, "_log", lambda self, level, message: logged.append(message))
    publish = PredictorNode.publish_diagnostics

    def counted(self: PredictorNode) -> None:
        published.append(self.diagnostics.message)
        publish(self)

    monkeypatch.setattr(PredictorNode, "publish_diagnostics", counted)
    with bench_of(PredictorNode, {"twin": str(make_twin(tmp_path / "twin"))}) as bench:
        logged.clear(), published.clear()
        for k in range(75):  # two texts that alternate
            bench.node.report(ERROR, f"refused: gripper/pose at {1795457735.283 + 0.013 * k:.3f} s; got -{k}.5e-07 m")
            bench.node.report(ERROR, f"no gripper/pose for {0.013 * k:.3f} s")
        assert len(logged) == len(published) == 2
        assert bench.node.diagnostics.message.endswith("for 0.962 s"), "a heartbeat says the newest"
        bench.node.report(WARN, "no gripper/pose for 1.000 s")
        assert len(logged) == 2 and published[-1].endswith("for 1.000 s"), "another level is published at once"
        bench.node.report(OK, "predicting")
        assert logged[-1] == published[-1] == "predicting"
        monkeypatch.setattr(shell, "AGAIN", 0.0)
        bench.node.report(ERROR, "no gripper/pose for 7.000 s")
        assert logged[-1] == "no gripper/pose for 7.000 s", "after a while it is news again"

"""The evaluator: pairs predictions with the tracks of the same instant, shows the running error, writes the score.

In: tracker/points, prediction/points, player/episode. Out: /diagnostics; at the end of the data (or on SIGINT)
`metrics.json` and `report.html` in the folder `out`.
"""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NoReturn

import torch
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from pred_core.bag.wire import PREDICTION_POINTS, TRACKER_POINTS
from pred_core.calibration import Calibration
from pred_core.config import setting
from pred_core.errors import ConfigError, PredError
from pred_core.live import marks
from pred_core.live.scoring import Scorer
from pred_core.twin import Twin
from pred_ros import convert, qos, shell
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.live_report import stage_name, write_results
from pred_ros.shell import Shell

UNNAMED = "prediction"  # the model, if neither `model` nor `twin` says more


@dataclass(frozen=True)
class EvaluatorConfig:
    """Parameters of the evaluator."""

    out: str = setting("out/live", doc="folder for metrics.json and report.html")
    model: str = setting("", doc="name of the predictor in metrics.json; empty: the stage of `twin`")
    twin: str = setting("", doc="folder of the twin that predicts; names the model, corrects tracks")
    tolerance: float = setting(0.001, unit="s", low=0.0, high=1.0, doc="how far apart the stamps of a pair may be")
    patience: float = setting(
        10.0, unit="s", low=0.1, high=600.0, doc="wait for missing data after the end of the replay"
    )
    exit_at_end: bool = setting(True, doc="end the process when the score is written")
    autostart: bool = setting(True, doc="configure and activate without a lifecycle manager")


class EvaluatorNode(Shell):
    """Callbacks only store; the score is computed once, at the end."""

    NAME: ClassVar[str] = "evaluator"
    CONFIG: ClassVar[type] = EvaluatorConfig

    def __init__(self) -> None:
        super().__init__()
        self._inputs: list[Subscription] = []
        self._begin_anew()

    def setup(self) -> None:
        """Make the output folder: a run must not fail at its end."""
        try:
            Path(self.config.out).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError("parameter 'out': the folder cannot be made", got=error) from error
        config: EvaluatorConfig = self.config
        twin = Twin.load(Path(config.twin)) if config.twin else None
        self._model = config.model or (UNNAMED if twin is None else stage_name(twin))
        self._calibration = Calibration() if twin is None else twin.calibration
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._scorer = Scorer(self.config.tolerance)
        self._ended: marks.EndMark | None = None
        self._news = time.monotonic()  # [s] when data last came
        self._written = False

    def start(self) -> None:
        """Subscribe."""
        torch.set_num_threads(1)
        complete = qos.points_complete()
        self._inputs = [
            self.create_subscription(String, marks.TOPIC, self._on_mark, qos.latched(1000)),
            self.create_subscription(PointCloud2, PREDICTION_POINTS, self._on_prediction, complete),
            self.create_subscription(PointCloud2, TRACKER_POINTS, self._on_points, complete),
        ]
        self._watch = self.create_timer(0.1, self._check_end)

    def stop(self) -> None:
        """Write what there is, if the end of the data did not come."""
        if not self._inputs:
            return
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self.destroy_timer(self._watch)
        self._inputs = []
        if not self._written and self._scorer.pairs:
            self._write()

    def heartbeat(self) -> None:
        """Running error and what is missing."""
        mde, l1 = self._scorer.running
        points, predictions = len(self._scorer.points.times), len(self._scorer.predictions.times)
        self.diagnostics.value("running mde [mm]", f"{1e3 * mde:.3f}")
        self.diagnostics.value("running coordinate_l1 [mm]", f"{1e3 * l1:.3f}")
        self.diagnostics.value("tracker/points", str(points))
        self.diagnostics.value("prediction/points", str(predictions))
        self.diagnostics.value("pairs", str(self._scorer.pairs))
        self.diagnostics.value("episodes released", str(self._scorer.released))
        if self.refusal:
            self.report(ERROR, self.refusal)
        elif not self._scorer.pairs:
            self.report(WARN, f"no pairs yet ({points} measured, {predictions} predicted frames)")
        elif math.isfinite(mde) and not self._written:
            self.report(OK, f"mean error {1e3 * mde:.2f} mm over {self._scorer.pairs} frames")

    def _check_end(self) -> None:
        if self._ended is None or self._written:
            return
        waited = time.monotonic() - self._news
        announced = self._scorer.announced >= self._ended.episodes
        if (announced and self._scorer.complete()) or waited > self.config.patience:
            try:
                self._write()
            except PredError as error:
                self.fail(error)
                return
            if self.config.exit_at_end:
                self.exit_code = 0

    def _write(self) -> None:
        self._written = True
        summary = write_results(self._scorer.episodes(), self._model, Path(self.config.out), self._scorer.released)
        self.report(WARN if summary.lost else OK, summary.line)
        print(f"{self.NAME}: {summary.line}", flush=True)

    def _on_mark(self, message: String) -> None:
        try:
            mark = marks.decode(message.data)
        except PredError as error:
            self.refuse(error)
            return
        if isinstance(mark, marks.EndMark):
            self._ended = mark
        else:
            self._scorer.add_mark(mark)
        self._news = time.monotonic()

    def _on_points(self, message: PointCloud2) -> None:
        self.take(TRACKER_POINTS, self._add_points, message)

    def _add_points(self, message: PointCloud2) -> None:
        frame = convert.cloud_to_points(message)
        true = self._calibration.correct_points(frame.position)
        self._scorer.add_points(dataclasses.replace(frame, position=true))
        self._news = time.monotonic()

    def _on_prediction(self, message: PointCloud2) -> None:
        self.take(PREDICTION_POINTS, self._add_prediction, message)

    def _add_prediction(self, message: PointCloud2) -> None:
        stamp, ids, state = convert.cloud_to_state(message, PREDICTION_POINTS)
        self._scorer.add_prediction(stamp, ids, state.position.double().numpy())
        self._news = time.monotonic()


def main() -> NoReturn:
    """Entry point of `ros2 run pred_ros evaluator`."""
    shell.main(EvaluatorNode)


if __name__ == "__main__":
    main()

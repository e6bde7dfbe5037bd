"""What the estimator believes about the model's errors and the tracks'."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.config import setting


@dataclass(frozen=True)
class EstimatorConfig:
    """Errors of the model are smooth along the body; errors of the tracks are not."""

    correlation: float = setting(
        0.08, unit="m", low=1e-3, high=10.0, doc="distance over which the model's errors are alike"
    )
    modes: int = setting(64, low=1, high=400, doc="most smooth shapes an error is made of")
    push: float = setting(0.6, unit="m/s^2", low=0.0, high=100.0, doc="unknown acceleration, over `memory`")
    drift: float = setting(0.015, unit="m/s^0.5", low=0.0, high=1.0, doc="random walk of the model's error")
    memory: float = setting(0.15, unit="s", low=0.01, high=10.0, doc="after which a velocity error has died away")
    noise: float = setting(0.001, unit="m", low=1e-6, high=0.1, doc="error of a coordinate of a track at confidence 1")
    confidence_scale: float = setting(
        0.01, unit="m", low=0.0, high=1.0, doc="error that takes confidence to 1/e, as the tracker writes it"
    )
    least_confidence: float = setting(
        0.5, low=0.0, high=1.0, doc="tracks at or below it are guesses of hidden places, and not used"
    )
    gate: float = setting(4.5, low=1.0, high=100.0, doc="standard deviations; a track farther off is wrong")
    start_position: float = setting(0.005, unit="m", low=1e-6, high=1.0, doc="error of a state at its start")
    start_velocity: float = setting(0.1, unit="m/s", low=1e-6, high=10.0, doc="error of a velocity at its start")
    start_window: float = setting(0.25, unit="s", low=0.0, high=5.0, doc="of tracks that a start is made of")
    least_seen: float = setting(0.5, low=0.05, high=1.0, doc="share of the particles a start needs")
    history: float = setting(0.6, unit="s", low=0.02, high=10.0, doc="oldest capture time that still corrects")
    lost_share: float = setting(0.5, low=0.05, high=1.0, doc="share of rejected tracks that means: lost")
    lost_after: float = setting(0.5, unit="s", low=0.0, high=10.0, doc="of being lost; then it starts anew")
    slipped: float = setting(
        0.05, unit="m", low=0.001, high=1.0, doc="from its place in the jaws; when it starts anew, it is held no more"
    )
    warn_after: float = setting(0.5, unit="s", low=0.01, high=60.0, doc="without tracks; then it says so")
    stop_after: float = setting(2.0, unit="s", low=0.01, high=600.0, doc="without tracks; then no state is given")

"""What `pred identify` is told."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.config import setting

PAPER = ("stiffness", "damping", "connection_threshold", "max_springs", "ground_friction")


@dataclass(frozen=True)
class IdentifyConfig:
    """Defaults suit a cable or a rope; lengths are in seconds of recording."""

    parameters: tuple[str, ...] = setting(
        (*PAPER, "bending_stiffness"), doc="fields of Physics that are searched; the first five are the paper's"
    )
    effects: tuple[str, ...] = setting((), doc="effects whose parameters are searched too")
    restarts: int = setting(3, low=1, high=20, doc="CMA-ES runs, each with its own seed and start")
    evaluations: int = setting(400, low=20, high=100_000, doc="candidates per restart")
    window: float = setting(2.0, unit="s", low=0.05, high=600.0, doc="length of a window of the global search")
    windows: int = setting(24, low=1, high=1000, doc="windows of the global search, fixed for the run")
    stages: tuple[float, ...] = setting(
        (1.0, 2.5, 1e9),
        unit="s",
        low=0.05,
        doc="window lengths of the refinement, in order; one longer than the episodes means whole episodes",
    )
    iterations: int = setting(30, low=0, high=200, doc="refinement steps a stage; 0: CMA-ES alone")
    shrink: float = setting(0.0, unit="m", low=0.0, high=1.0, doc="pull of profiles towards off in the refinement")
    stride: int = setting(5, low=1, high=1000, doc="frames between the residuals the refinement reads")
    estimate_starts: bool = setting(True, doc="fit starts over several frames instead of two")
    hold_out: float = setting(0.2, low=0.0, high=0.9, doc="share of the train recordings kept for the check")
    substeps: int | None = setting(
        None, low=1, high=20_000, doc="most substeps a period; bounds stiffness; absent: a substep of 0.5 ms"
    )
    mass: float = setting(0.1, unit="kg", low=1e-6, high=1e4, doc="total mass where the data set knows none (nominal)")
    ground: float | None = setting(
        None, unit="m", doc="height of the table; absent: what the data set knows, else nothing is touched"
    )
    radius: float | None = setting(
        None, unit="m", low=0.0, high=1.0, doc="particle radius in contact; absent: what the data set knows, else 0"
    )
    seed: int = setting(0, low=0, high=2**31 - 1, doc="of windows, hold-out and searches")

"""What the model-free gate says: one entry a cause, and the calibration that the accepted ones make."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pred_core.calibration import Calibration

Range = tuple[float, float]
SENSOR_IDS = ("delay", "camera_scale", "camera_rotation", "camera_translation", "gripper_offset")


@dataclass(frozen=True)
class GateCause:
    """One cause: how much of it, how sure, and whether these data could show it."""

    id: str  # delay, camera_scale, camera_rotation, camera_translation, gripper_offset, grip_slip, table_height, ...
    accepted: bool
    testable: bool
    why: str  # why it is not testable, not accepted, or what it rests on
    unit: str = ""
    parameters: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    interval: Mapping[str, tuple[Range, ...]] = dataclasses.field(default_factory=dict)  # 90 %, per component
    p_value: float = 1.0
    p_adjusted: float = 1.0  # by Holm over all causes that could be tested
    effect_mm: float = 0.0  # root mean square of what it does to the object's points
    confused_with: tuple[str, ...] = ()  # explain these data as well


@dataclass(frozen=True)
class GateResult:
    """All causes, accepted ones first."""

    causes: tuple[GateCause, ...]
    calibration: Calibration  # the twin's, with the accepted measurement causes in it
    change: Calibration  # only what was found now
    sigma: float  # [m] noise of the tracks
    episodes: int
    reference: int  # episodes it is compared with; 0: with the twin and with zero
    slides: Mapping[str, tuple[float, ...]]  # episode -> path [m] in the jaws every half second; if the rope slides
    notes: tuple[str, ...]

    sensor_ids = SENSOR_IDS  # causes that are corrected where data enter; the others are physics

    @property
    def accepted(self) -> tuple[GateCause, ...]:
        """The causes that were found."""
        return tuple(c for c in self.causes if c.accepted)

    def cause(self, id: str) -> GateCause:
        """The entry of one cause."""
        return next(c for c in self.causes if c.id == id)

    def to_json(self) -> dict[str, Any]:
        """Plain values for `diagnosis.json`."""
        return {
            "causes": [dataclasses.asdict(c) for c in self.causes],
            "calibration": dataclasses.asdict(self.calibration),
            "change": dataclasses.asdict(self.change),
            "sigma_mm": 1e3 * self.sigma,
            "episodes": self.episodes,
            "reference_episodes": self.reference,
            "slides": {k: list(v) for k, v in self.slides.items()},
            "notes": list(self.notes),
        }

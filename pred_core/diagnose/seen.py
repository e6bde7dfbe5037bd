"""What the gate found that is physics, where no candidate has its name."""

from __future__ import annotations

from pred_core.diagnose.gate import SMALLEST_SLIDE
from pred_core.diagnose.gate_result import GateResult
from pred_core.diagnose.gate_table_causes import PLANE_CAUSES
from pred_core.diagnose.progress import Progress
from pred_core.effects import LIBRARY

SLIDING = 3  # episodes in which held particles must slide: in one the track of the jaws may have wandered


def seen_only(gate: GateResult, progress: Progress) -> dict[str, float]:
    """Cause -> its size [mm] at the object. Where a table lies is known from a reference only."""
    named = {f for n in progress.named for f in n.judged.trial.family.split("+")}
    sliding = sum(max(map(abs, path), default=0.0) > SMALLEST_SLIDE for path in gate.slides.values())
    cold = progress.bench.reference is None
    rows = {c.id: c.effect_mm for c in gate.accepted if c.id not in gate.sensor_ids}
    return {
        id: size
        for id, size in rows.items()
        if (LIBRARY[id].family if id in LIBRARY else "table") not in named
        and (id != "grip_slip" or sliding >= min(SLIDING, len(gate.slides)))
        and not (cold and id in PLANE_CAUSES)
    }

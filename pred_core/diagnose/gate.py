"""The model-free gate: what sensors, clocks, the grip and the table get wrong, before any simulation is blamed.

Held particles must follow their gripper. Where they do not, the delay, the scale, the turn, the shift, an offset in
the gripper's frame or a slide in the jaws shows, each with its own dependence on the gripper's motion; whole episodes
are fitted jointly, robustly, and judged by leaving out episodes. With a reference everything is the change against it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pred_core.calibration import Calibration
from pred_core.diagnose.gate_checks import clock_notes, noise_of
from pred_core.diagnose.gate_fit import SCALE, SHIFT, TURN
from pred_core.diagnose.gate_joint import OFFSET, Joint
from pred_core.diagnose.gate_result import GateCause, GateResult
from pred_core.diagnose.gate_select import LEVEL, SENSOR_CAUSES, Selection, select
from pred_core.diagnose.gate_slide import AXES, Slide, find_slide
from pred_core.diagnose.gate_table_causes import table_causes
from pred_core.diagnose.gate_tracks import held_tracks
from pred_core.errors import DatasetError
from pred_core.twin import Twin
from pred_core.types import Array, Episode

FEWEST = 10  # train episodes that the gate's intervals are made for
SMALLEST = 3e-4  # [m] at the object: less is not worth a name
SMALLEST_SLIDE = 3e-3  # [m]
OTHERS = 4  # tests besides the sensors': slide, table height, tilt and relief

__all__ = ["GateCause", "GateResult", "measure"]


def measure(
    episodes: Sequence[Episode],
    reference: Sequence[Episode] | None,
    twin: Twin,
    reference_calibration: Calibration | None = None,
) -> GateResult:
    """Judge `episodes` against `reference` (of the same object, without the effect), else against the twin and zero.

    Both are first corrected by the calibration the twin has; the reference by `reference_calibration` if that is given,
    for a twin that was calibrated for `episodes` alone. Raises: DatasetError without episodes.
    """
    if not episodes:
        raise DatasetError("there are no episodes to judge", next_step="Give some episodes 'split: train'")
    suspect = [twin.calibration.correct(e) for e in episodes]
    before = twin.calibration if reference_calibration is None else reference_calibration
    known = [before.correct(e) for e in reference or ()]
    sigma = noise_of(suspect)
    notes = list(clock_notes(suspect))
    if len(suspect) < FEWEST:
        count = "1 train episode" if len(suspect) == 1 else f"{len(suspect)} train episodes"
        notes.append(f"the gate's own intervals are from {count}, fewer than the {FEWEST} they are made for")
    causes, change, slides = _sensor_causes(suspect, known, twin, sigma, notes)
    corrected = [change.correct(e) for e in suspect]
    causes += table_causes(corrected, known, twin.scene.ground, twin.body.radius, sigma, len(SENSOR_CAUSES) + OTHERS)
    return GateResult(
        causes=tuple(sorted(causes, key=lambda c: (not c.accepted, c.p_value))),
        calibration=twin.calibration.then(change),
        change=change,
        sigma=sigma,
        episodes=len(suspect),
        reference=len(known),
        slides=slides,
        notes=tuple(notes),
    )


def _sensor_causes(
    suspect: list[Episode], known: list[Episode], twin: Twin, sigma: float, notes: list[str]
) -> tuple[list[GateCause], Calibration, dict[str, tuple[float, ...]]]:
    tracks = {e.name: t for e in suspect if (t := held_tracks(e))}
    before = [t for e in known if (t := held_tracks(e))]
    ids = [c.id for c in SENSOR_CAUSES] + ["grip_slip"]
    if len(tracks) < 2:
        notes.append("the gate needs two episodes with a held particle that is seen")
        return [GateCause(i, False, False, "no held particle is seen in two episodes") for i in ids], Calibration(), {}
    if known and not before:
        notes.append("the reference holds nothing: compared with the twin and with zero")
    levers = {id: np.array(lever) for id, lever in twin.meta.levers}
    joint = Joint(list(tracks.values()), before, levers or None)
    slide = find_slide(joint)
    family = len(SENSOR_CAUSES) + OTHERS
    slips = slide.largest.max() >= SMALLEST_SLIDE and min(1.0, family * slide.p_value) <= LEVEL
    if slips:
        joint = slide.joint
    reach = _reach(suspect, joint.center)
    smallest = {
        "delay": SMALLEST / max(reach["speed"], 1e-6), "camera_scale": SMALLEST / reach["distance"],
        "camera_rotation": SMALLEST / reach["distance"], "camera_translation": SMALLEST, "gripper_offset": SMALLEST,
    }  # fmt: skip
    floor = max(1.0, 0.5 * sigma / SMALLEST)  # half of the noise at least
    selection = select(joint, OTHERS, {k: v * floor for k, v in smallest.items()})
    change = _calibration(selection, joint.center)
    causes = [_sensor_cause(c.id, selection, joint, reach, change) for c in SENSOR_CAUSES]
    causes.append(_slip_cause(slide, bool(slips), family))
    paths = dict(zip(tracks, (tuple(map(float, p)) for p in slide.paths), strict=True)) if slips else {}
    return causes, change, paths


def _reach(episodes: list[Episode], center: Array) -> dict[str, float]:
    """Root mean squares over the object's points: speed [m/s] (over 0.1 s) and distance from the centre [m]."""
    speeds, distances = [], []
    for e in episodes:
        lag = max(1, round(0.1 / e.period))
        x = np.where(e.tracks.visible[..., None], e.position, np.nan)
        speeds.append(np.nanmean(((x[lag:] - x[:-lag]) ** 2).sum(-1)) / (lag * e.period) ** 2 if len(x) > lag else 0.0)
        distances.append(np.nanmean(((x - center) ** 2).sum(-1)))
    return {"speed": float(np.sqrt(np.mean(speeds))), "distance": float(np.sqrt(np.mean(distances)))}


def _calibration(selection: Selection, center: Array) -> Calibration:
    change, found = selection.fit.change, set(selection.accepted)
    camera = found & {"camera_scale", "camera_rotation", "camera_translation"}
    return Calibration(
        delay=float(change[0]) if "delay" in found else 0.0,
        scale=1.0 + float(change[SCALE][0]) if "camera_scale" in found else 1.0,
        rotation=_three(change[TURN]) if "camera_rotation" in found else (0.0, 0.0, 0.0),
        center=_three(center) if camera else (0.0, 0.0, 0.0),
        translation=_three(change[SHIFT]) if camera else (0.0, 0.0, 0.0),
        gripper_offset=_three(change[OFFSET]) if "gripper_offset" in found else (0.0, 0.0, 0.0),
    )


def _sensor_cause(
    id: str, selection: Selection, joint: Joint, reach: dict[str, float], change: Calibration
) -> GateCause:
    cause = next(c for c in SENSOR_CAUSES if c.id == id)
    if id not in selection.tests:
        return GateCause(id, False, False, "a constant offset needs a reference or a twin that knows the levers")
    t = selection.tests[id]
    accepted = id in selection.accepted
    size = float(np.linalg.norm(t.estimate))
    effect = {"delay": reach["speed"], "camera_scale": reach["distance"], "camera_rotation": reach["distance"]}
    if accepted:
        why = f"{joint.episodes} episodes, {joint.freedom} degrees of freedom"
    elif not t.resolved:
        why = "these motions do not excite it: its error would hide an amount that matters"
    elif id == "camera_translation" and {"camera_scale", "camera_rotation"} & set(selection.accepted):
        why = "part of the scale or rotation that was found"
    else:
        why = "not significant, or too small to matter, beside what was found"
    return GateCause(
        id=id,
        accepted=accepted,
        testable=t.resolved,
        why=why,
        unit=cause.unit,
        parameters={cause.name: tuple(map(float, t.estimate))},
        interval={cause.name: tuple((float(a), float(b)) for a, b in t.interval)},
        p_value=t.p_value,
        p_adjusted=selection.adjusted.get(id, 1.0),
        effect_mm=1e3 * size * effect.get(id, 1.0),
        confused_with=selection.confused.get(id, ()),
    )


def _slip_cause(slide: Slide, accepted: bool, family: int) -> GateCause:
    ends = np.array([p[-1] for p in slide.paths])
    margin = 1.645 * slide.joint.noise
    return GateCause(
        id="grip_slip",
        accepted=accepted,
        testable=True,
        why=f"along the gripper's {AXES[slide.axis]} axis; {int((slide.largest > SMALLEST_SLIDE).sum())} of "
        f"{len(ends)} episodes move by more than {1e3 * SMALLEST_SLIDE:g} mm",
        unit="m",
        parameters={"path": (float(ends.mean()),), "largest": (float(slide.largest.max()),)},
        interval={"largest": ((float(slide.largest.max() - margin), float(slide.largest.max() + margin)),)},
        p_value=slide.p_value,
        p_adjusted=min(1.0, family * slide.p_value),
        effect_mm=1e3 * float(np.sqrt(np.mean(ends**2))),
    )


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z

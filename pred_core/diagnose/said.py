"""What a person reads: the one sentence, and what no data of this kind can tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pred_core.diagnose.refining import moved_in_words
from pred_core.diagnose.skill import POOR
from pred_core.effects import LIBRARY, confounded
from pred_core.types import Episode

if TYPE_CHECKING:
    from pred_core.diagnose.progress import Progress
    from pred_core.diagnose.result import Cause, Diagnosis, Errors

NAMES = {
    "bending_by_angle": "resistance to bending by angle, instead of springs that skip particles",
    "rest_curvature": "a rest curvature that varies along the object",
    "drag_linear": "air drag", "drag_quadratic": "quadratic air drag", "drag_power": "air drag with another power",
    "gravity_offset": "another gravity direction",
    "length_drift": "length that drifts over the session", "length_scale": "another length",
    "stretch_scale": "another axial stiffness", "strain_stiffening": "stiffening with stretch",
    "bending_stiffening": "stiffening with bending",
    "bending_damping": "damping in bending", "bending_hysteresis": "dry friction inside the cable", "wind": "wind",
    "attraction": "a force towards a place", "tether": "a thread to a fixed point", "obstacle": "an obstacle",
    "friction_scale": "another friction coefficient", "friction_viscous": "viscous friction on the table",
    "friction_power": "friction that grows with another power of the speed",
    "friction_anisotropic": "friction that depends on the direction", "friction_patch": "a patch of other friction",
    "table_height": "another table height", "table_tilt": "a tilted table",
    "table_relief": "a table that is not flat", "tip_mass": "mass at the tip",
    "mass_gradient": "mass that changes along the object", "bending_scale": "another bending stiffness",
    "bending_region": "a piece of other stiffness", "bending_gradient": "stiffness that changes along the object",
    "friction_drift": "friction that drifts over the session",
    "stiffness_drift": "stiffness that drifts over the session",
    "bending_creep": "creep of the rest shape", "bending_plasticity": "plastic bending", "rest_bow": "a rest curvature",
    "grip_slip": "slip in the gripper", "delay": "a delay of the tracks", "camera_scale": "a scale error of the camera",
    "camera_rotation": "a rotation of the camera", "camera_translation": "a shift of the camera",
    "gripper_offset": "an offset of the gripper frame",
}  # fmt: skip
FAR, HELPED = 3.0, 0.9  # times the median episode's error; share of its own that an episode keeps: no cause helped it
STILL = 0.01  # [m] of gripper travel in an episode below which nothing is excited


def called(cause: Cause) -> str:
    """A cause in words with its main number: its effect's headline, or the first of its parameters."""
    words = NAMES.get(cause.id, cause.id.replace("_", " "))
    if not cause.parameters:
        return words
    shown = LIBRARY[cause.id].headline if cause.id in LIBRARY else ""
    plain = [k.split("[")[0] for k in cause.parameters]
    name = shown if shown in plain else plain[0]
    values = [v for k, v in zip(plain, cause.parameters.values(), strict=True) if k == name]
    unit = "" if values[0].unit == "1" else f" {values[0].unit}"
    if len(values) == 1:
        v = values[0]
        return f"{words}: {v.value:.3g}{unit} {f'[{v.low:.3g}, {v.high:.3g}]' if v.interval else '(no interval)'}"
    if len(values) > 3:  # a profile
        return words
    return f"{words}: ({', '.join(f'{v.value:.3g}' for v in values)}){unit}"


def sentence(d: Diagnosis) -> str:
    """The sentence a report opens with; others where the gate saw physics that no candidate explains, and where the
    twin's own numbers were off."""
    text = _sentence(d)
    if d.seen:
        found = "; ".join(f"{NAMES.get(id, id)}, {size:.1f} mm at the object" for id, size in d.seen.items())
        text += f" Seen in the tracks, and named by no candidate: {found}."
    if d.refined is None or not d.refined.off:
        return text
    r, held = d.refined, "held-out" if d.errors.split == "test" else "fitted"
    return (
        f"{text} That is beside your twin's own numbers, which were off: {moved_in_words(r)}; refined on {r.on} "
        f"they take the {held} error from {r.given:.1f} to {r.base:.1f} mm."
    )


def _sentence(d: Diagnosis) -> str:
    e = d.errors
    held = "held-out error" if e.split == "test" else "error on the episodes it was fitted to"
    count = f"{e.gain.improved} of {e.gain.episodes} episodes"
    numbers = f"the {held} {trend(e)}, {count if falls(e) else f'lower in {count}'}"
    if not d.causes:  # nothing was added that could change it
        numbers = f"the {held} is {e.base.mean:.1f} mm"
    label = "Exploratory, too few episodes or recordings for a firm answer: " if d.exploratory else ""
    if d.outcome == "none":
        known = e.floor is not None or d.explained is None
        share = "" if known else f"; it explains {max(d.explained or 0.0, 0.0):.0%} of the motion"
        return f"{label}Nothing is found that your simulation lacks: its {held} is {e.base.mean:.1f} mm{share}."
    if d.outcome == "unknown" and _no_base(d):
        share = f"{max(d.explained or 0.0, 0.0):.0%} of the motion"
        found = "; and ".join(called(c) for c in d.causes if c.measured)
        found = f" Measured without it: {found}." if found else ""
        poor = f"Your twin explains {share}, too little to tell what it lacks: identify it anew"
        return f"{label}{poor}; {numbers}.{found}"
    near = next((c for c in d.causes if c.contradicted), None)
    if d.outcome == "unknown" and near is not None:
        beside = "; and ".join(called(c) for c in d.causes if c is not near)
        beside = f" Besides it lacks {beside}." if beside else ""
        return (
            f"{label}Your simulation lacks something whose law no candidate has. The nearest is {called(near)}, but "
            f"{near.contradicted}; with it {numbers}.{beside}"
        )
    if d.outcome == "unknown":
        some = "; and ".join(called(c) if c.measured else NAMES.get(c.id, c.id) for c in d.causes)
        partly = f" ({some} explain{'s' if len(d.causes) == 1 else ''} a part)" if some else ""
        return f"{label}Your simulation lacks something that no candidate explains{partly}; {numbers}."
    what = "; and ".join(called(c) + (f" (nearly: {c.contradicted})" if c.contradicted else "") for c in d.causes)
    group = tuple(g for c in d.causes for g in c.group)
    unsure = f" (or {', '.join(NAMES.get(g, g) for g in group)}: these data do not tell)" if group else ""
    more = " Something else is left that no candidate explains." if d.more else ""
    return f"{label}Your simulation lacks {what}{unsure}; with it {numbers}.{more}"


def falls(e: Errors) -> bool:
    """Whether the error gets smaller, in the one digit that is shown."""
    return e.extended.mean < e.base.mean and f"{e.extended.mean:.1f}" != f"{e.base.mean:.1f}"


def trend(e: Errors) -> str:
    """What the error does from base to extended: "falls from 24.4 to 5.0 mm", "rises from ..", "stays at .."."""
    before, after = f"{e.base.mean:.1f}", f"{e.extended.mean:.1f}"
    if before == after:
        return f"stays at {before} mm"
    return f"{'falls' if falls(e) else 'rises'} from {before} to {after} mm"


def unproven(causes: Sequence[Cause], e: Errors, window: float) -> str:
    """That whole episodes do not bear out what was named on windows of `window` [s]; "" where they do."""
    if not causes or falls(e):
        return ""
    measured = all(c.measured for c in causes)
    how = "measured without the simulation" if measured else f"judged on windows of {window:g} s"
    held = "whole held-out episodes" if e.split == "test" else "the whole episodes it was fitted to"
    return (
        f"what was found was {how}; on {held} the error did not fall ({e.base.mean:.1f} to {e.extended.mean:.1f} mm): "
        f"the {'calibration' if measured else 'extension'} should not be used for prediction unchecked"
    )


def unmoved(causes: Sequence[Cause], e: Errors) -> str:
    """Episodes that still err FAR times what the others do and that no named cause has made better; "" without any."""
    usual = float(np.median(e.extended.values))
    rows = [
        f"{name} ({after:.1f} of {before:.1f} mm left)"
        for name, before, after in zip(e.base.names, e.base.values, e.extended.values, strict=True)
        if after > FAR * usual and after > HELPED * before
    ]
    return f"not explained by what was named: {', '.join(rows)}" if causes and rows else ""


def without_interval(causes: Sequence[Cause]) -> str:
    """Which parameters have none; "" if all have one."""
    rows = [
        f"{NAMES.get(c.id, c.id)} ({name})" for c in causes for name, v in c.parameters.items() if not v.interval
    ]
    if not rows:
        return ""
    return f"no interval for {', '.join(rows)}: low and high are null in diagnosis.json"


def _no_base(d: Diagnosis) -> bool:
    """The twin is no good where nothing is hidden either, as far as that was measured."""
    if d.explained is None or d.explained >= POOR:
        return False
    return d.errors.floor is None or d.errors.floor > 0.5 * d.errors.extended.mean


def confusions(d: Diagnosis, c: Cause) -> dict[str, list[str]]:
    """What is often confused with a cause, by what these data say of it; what was found beside it is left out."""
    measured = {g.id for g in d.gate.causes if g.testable and not g.accepted}
    screened = {i for seen in d.rounds for i, _ in seen.screened}
    told, some, no = "Told apart here", "only screened", "not tried here, or not testable"
    rows: dict[str, list[str]] = {told: [], some: [], no: []}
    named = {o.id for o in d.causes}
    for i in confounded(c.id) if c.id in LIBRARY else ():
        if i in named:
            continue
        if i in d.not_testable:
            rows[no].append(i)
        elif i in d.judged_ids | measured:
            rows[told].append(i)
        else:
            rows[some if i in screened else no].append(i)
    return rows


def not_identifiable(progress: Progress, episodes: Sequence[Episode]) -> list[str]:
    """What these data cannot tell, whatever the method."""
    rows = ["absolute mass (no force was measured: only ratios of forces and masses act)"]
    twin = progress.bench.twin
    moves = [float(np.ptp(e.grips.position.double().numpy(), axis=0).max(initial=0.0)) for e in episodes]
    if not moves or max(moves) < STILL:
        rows.append("anything that needs motion of the gripper (it stands still in every episode)")
    if twin.scene.ground is None:
        rows.append("friction and height of a table (nothing is touched)")
        rows.append("a tilt of gravity against a rotation of the camera (nothing touches a table)")
    rows.append("axial damping of a rope that hardly stretches")
    return rows

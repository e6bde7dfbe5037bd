"""How one diagnosis is judged against what was hidden, and the statistics of many.

The table `SAME` was written before any final case was diagnosed. The hidden world and the library were written apart
from each other: a pair stands here because both describe the same cause, whatever they call it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import beta

GRAVITY = 9.81  # [m/s^2]
ROPE_RADIUS = 0.004  # [m], which the library counts into the radius of an obstacle
LEVEL = 0.95  # of every interval
RESAMPLED = 4000
BINS = ((0.0, 1.1), (1.1, 1.3), (1.3, math.inf))  # error of the base over that with nothing hidden


@dataclass(frozen=True)
class Same:
    """A hidden effect and what the library calls it."""

    id: str  # "": the library has no name for it
    family: str  # the library's; "": nothing there is of its kind
    parameter: str = ""  # that means the same as the magnitude; "": none does
    scale: float = 1.0  # parameter = offset + scale * magnitude
    offset: float = 0.0
    reads: str = "value"  # or "norm" of a vector, "lean" of gravity [deg], "base" times 1 + magnitude


SAME: Mapping[str, Same] = {
    # Damping of all free motion through the air, by a power of the speed.
    "drag_linear": Same("drag_linear", "drag", "coefficient"),
    "drag_quadratic": Same("drag_quadratic", "drag", "coefficient"),
    # The same with a power between the two: the family is right, and each of the two laws is wrong.
    "drag_three_halves": Same("", "drag"),
    # Air that moves past the rope. A gust is no wind: it is a uniform force that reverses and does not see speed.
    "wind": Same("wind", "wind", "velocity", reads="norm"),
    "gust": Same("", ""),
    # A change of the vector of gravity, as an angle or as a vector that is added.
    "gravity_tilt": Same("gravity_offset", "gravity", "acceleration", reads="lean"),
    # How hard the table resists sliding: everywhere the same, by speed, by direction.
    "friction_scale": Same("friction_scale", "friction", "change"),
    "friction_viscous": Same("friction_viscous", "friction", "coefficient"),
    "friction_anisotropic": Same("friction_anisotropic", "friction", "components", reads="norm"),
    # A round place of the table with other friction, the same bell in both.
    "sticky_patch": Same("friction_patch", "patch", "change"),
    # Where the table's surface is. Ridges are a height that changes along x, for which there is no law; a table
    # that shakes keeps its surface where it is.
    "table_height": Same("table_height", "table", "height"),
    "table_wave": Same("", "table"),
    "table_vibration": Same("", ""),
    # Something solid that nobody told of.
    "obstacle": Same("obstacle", "obstacle", "radius", offset=ROPE_RADIUS),
    # A property of object or table that grows with the time of the session.
    "friction_drift": Same("friction_drift", "drift", "rate"),
    "stiffness_drift": Same("stiffness_drift", "drift", "rate"),
    # How hard the rope resists being bent, as a whole or in a piece. A box and a bell have no parameter in common.
    "bending_stiffness": Same("bending_scale", "bending", "change"),
    "stiff_region": Same("bending_region", "bending"),
    # How its mass is spread.
    "heavy_tip": Same("tip_mass", "mass", "change"),
    "mass_gradient": Same("mass_gradient", "mass", "slope"),
    # A loss in proportion to the rate of bending: 1 + a times the time constant the base has. Dry friction in one
    # joint is a local defect, for which there is no law.
    "internal_damping": Same("bending_damping", "internal loss", "time", reads="base"),
    "hinge_friction": Same("", ""),
    # The rest shape follows the shape while the rope is bent.
    "creep": Same("bending_creep", "plastic", "rate"),
    # It rests on a circle.
    "rest_curvature": Same("rest_bow", "rest_shape", "curvature", reads="norm"),
    # How it is held: it slides, or it is held elsewhere than the robot reports.
    "gripper_slip": Same("grip_slip", "slip", "weakness"),
    "gripper_offset": Same("gripper_offset", "gripper_offset", "offset", reads="norm"),
    # A pull towards a place, or by a thread from a place.
    "attraction": Same("attraction", "attraction", "strength"),
    "tether": Same("tether", "tether", "stiffness"),
    # What the sensors get wrong: time, and the similarity of reported and true points.
    "action_delay": Same("delay", "delay", "delay", scale=1e-3),
    "camera_scale": Same("camera_scale", "camera", "scale"),
    "camera_rotation": Same("camera_rotation", "camera", "rotation", scale=math.pi / 180.0, reads="norm"),
    # Nothing in the library does these.
    "swirl": Same("", ""),
    "repulsion": Same("", ""),
}
# A scale or a turn about the camera is one about another centre and a translation: the latter is no second cause.
BESIDE = {"camera_translation": ("camera_scale", "camera_rotation")}


@dataclass(frozen=True)
class Judgement:
    """One case: what was hidden, what was answered, and what follows."""

    name: str
    reference: str
    hidden: tuple[str, ...]
    outcome: str
    named: tuple[str, ...]  # ids, only where the outcome is a name or a group
    families: tuple[str, ...]  # of them
    group: tuple[str, ...]  # what cannot be told apart from the first, itself included
    confidence: float  # probability of what was answered
    on_truth: float  # probability given to the truth; to either of two
    parameter_error: float | None  # relative, where the name is right and a parameter means the same
    covered: bool | None  # its 90 % interval holds the truth
    base: float  # [mm] held out
    extended: float
    oracle: float | None
    base_ood: float | None
    extended_ood: float | None
    oracle_ood: float | None
    seconds: float
    paired: float | None = None  # [mm] of the base on the same motions with nothing hidden

    @property
    def kind(self) -> str:
        """control, single, unlisted or pair."""
        if len(self.hidden) != 1:
            return "pair" if self.hidden else "control"
        return "single" if SAME[self.hidden[0]].id else "unlisted"

    @property
    def truths(self) -> tuple[str, ...]:
        """The library's names of what was hidden."""
        return tuple(SAME[h].id for h in self.hidden if SAME[h].id)

    @property
    def truth_families(self) -> tuple[str, ...]:
        """Their families."""
        return tuple(SAME[h].family for h in self.hidden if SAME[h].family)

    @property
    def right(self) -> bool:
        """What was answered is the truth: none, unknown, or the first name."""
        if self.kind == "control":
            return self.outcome == "none"
        if self.kind == "unlisted":
            return self.outcome == "unknown"
        return bool(self.named) and self.named[0] in self.truths


def judged(
    name: str,
    reference: str,
    hidden: Sequence[tuple[str, float]],
    answer: Mapping[str, Any],
    base: Mapping[str, float],
    oracle: Mapping[str, Any] | None,
    paired: Mapping[str, Any] | None = None,
) -> Judgement:
    """Judge one `diagnosis.json`.

    `base`: values of the commissioned twin, for magnitudes relative to it; `oracle`, `paired`: errors of the twin with
    the true law, and of the base with nothing hidden.
    """
    causes = _causes(answer) if answer["outcome"] in ("named", "group") else []
    named = tuple(c["id"] for c in causes)
    error, covered = None, None
    if len(hidden) == 1 and named and named[0] == SAME[hidden[0][0]].id:
        error, covered = parameter_error(*hidden[0], causes[0]["parameters"], base)
    mm, ood = answer["error_mm"], answer["error_mm_ood"]
    effects = tuple(h for h, _ in hidden)
    return Judgement(
        name=name, reference=reference, hidden=effects, outcome=answer["outcome"], named=named,
        families=tuple(c["family"] for c in causes),
        group=tuple(dict.fromkeys((named[0], *causes[0].get("group", ())))) if named else (),
        confidence=_confidence(answer, causes), on_truth=_on_truth(answer, effects), parameter_error=error,
        covered=covered, base=mm["base"], extended=mm["extended"],
        oracle=None if oracle is None else oracle["error_mm"],
        base_ood=ood.get("base"), extended_ood=ood.get("extended"),
        oracle_ood=None if oracle is None else oracle["error_mm_ood"], seconds=answer["seconds"],
        paired=None if paired is None else paired["error_mm"],
    )  # fmt: skip


def _causes(answer: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    ids = {c["id"] for c in answer["causes"]}
    return [c for c in answer["causes"] if not ids & set(BESIDE.get(c["id"], ()))]


def _confidence(answer: Mapping[str, Any], causes: Sequence[Mapping[str, Any]]) -> float:
    return _probability(answer, causes[0]["id"] if causes else answer["outcome"])


def _on_truth(answer: Mapping[str, Any], hidden: Sequence[str]) -> float:
    if not hidden:
        return _probability(answer, "none")
    return max(_probability(answer, SAME[h].id or "unknown") for h in hidden)


def _probability(answer: Mapping[str, Any], id: str) -> float:
    """What the answer gives an id: a cause that is measured, or one of a pair, stands among the causes only."""
    ranked = {r["id"]: float(r["probability"]) for r in answer["ranking"]}
    measured = {c["id"]: float(c["probability"]) for c in answer["causes"]}
    if measured and answer["causes"][0].get("kind") == "measurement" and id in ("none", "unknown"):
        return (1.0 - float(answer["causes"][0]["probability"])) * ranked.get(id, 0.0)
    stands_alone = any(c["id"] == id and c.get("kind") == "measurement" for c in answer["causes"])
    return measured[id] if id in measured and (stands_alone or id not in ranked) else ranked.get(id, 0.0)


def parameter_error(
    effect: str, magnitude: float, found: Mapping[str, Any], base: Mapping[str, float]
) -> tuple[float | None, bool | None]:
    """(relative error, whether the 90 % interval holds the truth); None where nothing can be compared.

    The interval of a vector's components says nothing of its length: only scalars are judged by it.
    """
    same = SAME[effect]
    if not same.parameter:
        return None, None
    truth = same.offset + same.scale * magnitude
    if same.reads == "base":
        if same.parameter not in base:
            return None, None
        truth = base[same.parameter] * (1.0 + magnitude)
    values = [v for k, v in found.items() if k.split("[")[0] == same.parameter]
    if not values:
        return None, None
    numbers = np.array([v["value"] for v in values], dtype=float)
    if same.reads == "norm":
        return abs(float(np.linalg.norm(numbers)) - truth) / abs(truth), None
    if same.reads == "lean":
        lean = math.degrees(math.atan2(math.hypot(numbers[0], numbers[1]), GRAVITY - numbers[2]))
        return abs(lean - truth) / abs(truth), None
    if values[0]["low"] is None:  # nobody measured an interval
        return abs(float(numbers[0]) - truth) / abs(truth), None
    low, high = sorted((values[0]["low"], values[0]["high"]))
    return abs(float(numbers[0]) - truth) / abs(truth), bool(low <= truth <= high)


def strengths(rows: Sequence[Judgement]) -> dict[str, float]:
    """Case -> error of its base over that without its effects: on the same motions; 1 for a control.

    Where that is not known, over the mean of its reference's controls; 1 if there is no control at all.
    """
    controls = [r for r in rows if r.kind == "control"]
    result = {}
    for row in rows:
        usual = [c.base for c in controls if c.reference == row.reference] or [c.base for c in controls]
        if row.kind == "control":
            result[row.name] = 1.0
        elif row.paired is not None:
            result[row.name] = row.base / row.paired
        else:
            result[row.name] = row.base / float(np.mean(usual)) if usual else 1.0
    return result


def clopper_pearson(count: int, of: int) -> tuple[float, float]:
    """Exact 95 % interval of a share (Clopper and Pearson 1934)."""
    tail = (1.0 - LEVEL) / 2.0
    low = 0.0 if count == 0 else float(beta.ppf(tail, count, of - count + 1))
    high = 1.0 if count == of else float(beta.ppf(1.0 - tail, count + 1, of - count))
    return low, high


def quantile_interval(values: Sequence[float], share: float, seed: int = 0) -> tuple[float, float, float]:
    """(quantile, low, high): 95 % by the percentile bootstrap over cases."""
    data = np.asarray(values, dtype=float)
    draws = np.random.default_rng(seed).integers(0, len(data), (RESAMPLED, len(data)))
    found = np.quantile(data[draws], share, axis=1)
    tail = (1.0 - LEVEL) / 2.0
    return float(np.quantile(data, share)), float(np.quantile(found, tail)), float(np.quantile(found, 1.0 - tail))


def mean_interval(values: Sequence[float], seed: int = 0) -> tuple[float, float, float]:
    """(mean, low, high): 95 % by the percentile bootstrap over cases."""
    data = np.asarray(values, dtype=float)
    draws = np.random.default_rng(seed).integers(0, len(data), (RESAMPLED, len(data)))
    low, high = np.quantile(data[draws].mean(axis=1), ((1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0))
    return float(data.mean()), float(low), float(high)


def calibration_error(confidence: Sequence[float], right: Sequence[bool], bins: int = 10) -> float:
    """Expected calibration error: mean |share right - mean confidence| over equal bins, weighted by their cases."""
    p, hit = np.asarray(confidence, dtype=float), np.asarray(right, dtype=float)
    place = np.minimum((p * bins).astype(int), bins - 1)
    gaps = [abs(float((hit - p)[place == b].sum())) for b in range(bins)]
    return sum(gaps) / len(p)


def brier(confidence: Sequence[float], right: Sequence[bool]) -> float:
    """Mean square of confidence minus hit."""
    return float(np.mean((np.asarray(confidence, dtype=float) - np.asarray(right, dtype=float)) ** 2))

"""Which changes of the sensors the data ask for: tested one by one, the largest first, then what else would do.

A cause is tested by its own unknowns (Hotelling's T^2 with the jackknife covariance over episodes) beside those
already accepted. Scale and rotation bring a free shift along, because the camera's place is not known; a shift that
needs neither is a cause of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student

from pred_core.diagnose.gate_fit import DELAY, SCALE, SHIFT, TURN
from pred_core.diagnose.gate_joint import CHANGES, OFFSET, Fit, Joint
from pred_core.types import Array

LEVEL = 0.05  # family-wise
TRUST = 0.9  # of intervals
SAME = 0.02  # share of the gain by which another cause may be worse and still explain the data as well


@dataclass(frozen=True)
class Cause:
    """Columns of the change that are the cause itself, and those that come with it."""

    id: str
    own: slice
    along: slice | None
    unit: str
    name: str  # of the parameter
    typical: float  # what matters: data that cannot resolve a quarter of it do not test the cause


SENSOR_CAUSES = (
    Cause("delay", DELAY, None, "s", "delay", 0.02),
    Cause("camera_scale", SCALE, SHIFT, "1", "scale", 0.02),
    Cause("camera_rotation", TURN, SHIFT, "rad", "rotation", 0.02),
    Cause("camera_translation", SHIFT, None, "m", "translation", 0.01),
    Cause("gripper_offset", OFFSET, None, "m", "offset", 0.01),
)


@dataclass(frozen=True)
class Tested:
    """A cause beside the accepted ones."""

    cause: Cause
    estimate: Array  # own components
    interval: Array  # (components, 2)
    p_value: float
    gain: float  # sum of squares over the noise that it explains in the suspect episodes
    resolved: bool  # the data could show a quarter of what matters


@dataclass(frozen=True)
class Selection:
    """The accepted causes, every cause's test, and what cannot be told apart."""

    accepted: tuple[str, ...]
    tests: dict[str, Tested]
    adjusted: dict[str, float]
    confused: dict[str, tuple[str, ...]]
    fit: Fit


def columns(ids: set[str]) -> Array:
    """(CHANGES,) bool: what the causes free."""
    free = np.zeros(CHANGES, bool)
    for cause in SENSOR_CAUSES:
        if cause.id in ids:
            free[cause.own] = True
            if cause.along is not None:
                free[cause.along] = True
    return free


def select(joint: Joint, others: int, smallest: dict[str, float]) -> Selection:
    """Accept causes until no other passes. others: further tests of the family; smallest: [unit] that is material."""
    testable = [c for c in SENSOR_CAUSES if c.id != "gripper_offset" or joint.offset_known]
    family = len(testable) + others
    accepted: list[str] = []
    adjusted: dict[str, float] = {}
    while True:
        base = joint.fit(columns(set(accepted)))
        tests = {c.id: test(joint, c, set(accepted), base) for c in testable if c.id not in accepted}
        level = {k: min(1.0, (family - len(accepted)) * t.p_value) for k, t in tests.items()}
        adjusted |= level
        passed = [
            k for k, t in tests.items()
            if level[k] <= LEVEL and t.resolved and np.linalg.norm(t.estimate) >= smallest[k]
            and not (k == "camera_translation" and {"camera_scale", "camera_rotation"} & set(accepted))
        ]  # fmt: skip
        if not passed:
            break
        accepted.append(max(passed, key=lambda k: tests[k].gain))
    for k in list(accepted):  # what later ones made superfluous
        others_of = set(accepted) - {k}
        again = test(joint, _cause(k), others_of, joint.fit(columns(others_of)))
        superseded = k == "camera_translation" and bool({"camera_scale", "camera_rotation"} & others_of)
        if superseded or min(1.0, family * again.p_value) > LEVEL:
            accepted.remove(k)
            adjusted[k] = min(1.0, family * again.p_value)
    final = {}
    for c in testable:
        rest = set(accepted) - {c.id}
        final[c.id] = test(joint, c, rest, joint.fit(columns(rest)))
    confused = {k: _alternatives(joint, k, accepted, testable, family) for k in accepted}
    return Selection(tuple(accepted), final, adjusted, confused, joint.fit(columns(set(accepted))))


def test(joint: Joint, cause: Cause, beside: set[str], base: Fit) -> Tested:
    """One cause freed beside the accepted ones, against `base` without it."""
    fit = joint.fit(columns(beside | {cause.id}))
    estimate, covariance = fit.change[cause.own], fit.covariance[cause.own, cause.own]
    count = len(estimate)
    margin = student.ppf(0.5 + 0.5 * TRUST, joint.freedom) * np.sqrt(np.diag(covariance))
    freedom = joint.freedom - count + 1
    p_value = 1.0
    if freedom > 0:
        square = float(estimate @ np.linalg.solve(covariance, estimate))
        p_value = float(fisher.sf(square * freedom / (joint.freedom * count), count, freedom))
    return Tested(
        cause,
        estimate,
        np.stack((estimate - margin, estimate + margin), axis=1),
        p_value,
        float((base.losses - fit.losses).sum()),
        bool((4.0 * fit.white[cause.own] <= cause.typical).all()),
    )


def _alternatives(joint: Joint, id: str, accepted: list[str], testable: list[Cause], family: int) -> tuple[str, ...]:
    """Causes that explain the suspect episodes as well in place of `id`."""
    rest = set(accepted) - {id}
    base, with_it = joint.fit(columns(rest)), joint.fit(columns(rest | {id}))
    gain = float((base.losses - with_it.losses).sum())
    found = []
    for other in testable:
        if other.id in accepted:
            continue
        instead = joint.fit(columns(rest | {other.id}))
        worse = instead.losses - with_it.losses
        error = float(worse.std(ddof=1) / np.sqrt(len(worse))) if len(worse) > 1 else 0.0
        if worse.sum() > SAME * gain and worse.mean() > 2.0 * error:
            continue
        tested = test(joint, other, rest, base)
        if not tested.resolved or min(1.0, family * tested.p_value) <= LEVEL:
            found.append(other.id)
    return tuple(found)


def _cause(id: str) -> Cause:
    return next(c for c in SENSOR_CAUSES if c.id == id)

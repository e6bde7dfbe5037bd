"""Height, tilt and relief of the table as causes: against the reference's table, else against the twin's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import mannwhitneyu

from pred_core.diagnose.gate_result import GateCause
from pred_core.diagnose.gate_select import LEVEL
from pred_core.diagnose.gate_table import FEWEST, FLAT, Plane, compare, fit_plane
from pred_core.types import Episode

PLANE_CAUSES = ("table_height", "table_tilt")
RELIEF = "table_relief"
SMALLEST_CHANGE = 5e-4  # [m] against a reference
SMALLEST_ABSOLUTE = 2e-3  # [m] against the twin's plane: the particles' radius is not known better
LONG_ENOUGH = 0.05  # [m] deviation of the resting points along an axis from which on a tilt shows


def table_causes(
    suspect: Sequence[Episode],
    reference: Sequence[Episode],
    ground: float | None,
    radius: float,
    sigma: float,
    family: int,
) -> list[GateCause]:
    """Height [m] and slope of the plane that particles rest on, and how far they rest off it [m], as changes.
    family: tests that Holm corrects for.
    """
    before = fit_plane(reference, sigma) if reference else None
    plane = fit_plane(suspect, sigma, None if before is None else before.middle)
    if plane is None or (reference and before is None):
        return _not_testable("too few particles rest while the gripper moves", RELIEF, *PLANE_CAUSES)
    if before is None and ground is None:
        why = f"the twin has no table; particles rest at {1e3 * plane.value[0]:.1f} mm"
        return _not_testable(why, RELIEF, *PLANE_CAUSES)
    relief = _relief(plane, before, sigma, family)
    if any(p is not None and p.spread > max(FLAT, sigma) for p in (plane, before)):
        return [*relief, *_not_testable("what rests does not lie on one plane", *PLANE_CAUSES)]
    return [*relief, *_plane_causes(plane, before, ground, radius, sigma, family)]


def _not_testable(why: str, *ids: str) -> list[GateCause]:
    return [GateCause(i, False, False, why) for i in ids]


def _relief(plane: Plane, before: Plane | None, sigma: float, family: int) -> list[GateCause]:
    """Whether particles rest farther off their plane than in the reference: a rank test over episodes (Mann and Whitney
    1947), because one in which few particles rest may be far out.
    """
    if before is None:
        return _not_testable("needs a reference: how far particles rest off a plane depends on the tracks", RELIEF)
    if min(len(plane.spreads), len(before.spreads)) < FEWEST:
        return _not_testable("too few particles rest on one plane while the gripper moves", RELIEF)
    p = float(mannwhitneyu(plane.spreads, before.spreads, alternative="greater").pvalue)
    size = float(np.sqrt(max(plane.spread**2 - before.spread**2, 0.0)))
    smallest = max(SMALLEST_CHANGE, 0.5 * sigma)
    return [
        GateCause(
            id=RELIEF,
            accepted=min(1.0, family * p) <= LEVEL and size >= smallest,
            testable=True,
            why=f"particles rest {1e3 * plane.spread:.2f} mm off it, in the reference {1e3 * before.spread:.2f} mm",
            unit="m",
            parameters={"relief": (size,)},
            p_value=p,
            p_adjusted=min(1.0, family * p),
            effect_mm=1e3 * size,
        )
    ]


def _plane_causes(
    plane: Plane, before: Plane | None, ground: float | None, radius: float, sigma: float, family: int
) -> list[GateCause]:
    expected = np.array([(ground or 0.0) + radius, 0.0, 0.0]) if before is None else before.value
    covariance = plane.covariance if before is None else plane.covariance + before.covariance
    freedom = plane.episodes - 1 + (0 if before is None else before.episodes - 1)
    value = plane.value - expected
    smallest = SMALLEST_ABSOLUTE if before is None else max(SMALLEST_CHANGE, 0.5 * sigma)
    causes = []
    for id, part, name, unit in (
        ("table_height", slice(0, 1), "height", "m"),
        ("table_tilt", slice(1, 3), "slope", "1"),
    ):
        p, margin = compare(value, covariance, part, freedom)
        own = value[part]
        size = float(np.abs(own[0])) if id == "table_height" else float(np.linalg.norm(own * plane.extent))
        testable = id == "table_height" or bool((plane.extent >= LONG_ENOUGH).all())
        accepted = testable and min(1.0, family * p) <= LEVEL and size >= smallest
        causes.append(
            GateCause(
                id=id,
                accepted=accepted,
                testable=testable,
                why=f"particles rest in {plane.episodes} episodes, at {1e3 * plane.value[0]:.2f} mm"
                + ("" if before is None else f", in the reference at {1e3 * before.value[0]:.2f} mm")
                + ("" if testable else "; they rest along one direction only"),
                unit=unit,
                parameters={name: tuple(map(float, own))},
                interval={name: tuple((float(a), float(b)) for a, b in zip(own - margin, own + margin, strict=True))},
                p_value=p,
                p_adjusted=min(1.0, family * p),
                effect_mm=1e3 * size,
            )
        )
    return causes

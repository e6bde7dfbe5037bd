"""Does the rope slide in the jaws? Held particles that move along one of the gripper's axes while they are held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from pred_core.diagnose.gate_joint import CHANGES, OFFSET, Joint
from pred_core.types import Array

AXES = "xyz"


@dataclass(frozen=True)
class Slide:
    """Sliding along one axis of the gripper, the one that explains most."""

    axis: int
    joint: Joint  # the fit in which every episode may slide along it
    paths: tuple[Array, ...]  # a suspect episode's knots [m]
    largest: Array  # (E,) [m] largest displacement of every suspect episode
    p_value: float


def find_slide(joint: Joint, axis: int | None = None) -> Slide:
    """The sliding of the suspect episodes of `joint`, which itself knows no sliding."""
    tried = []
    for k in range(3) if axis is None else (axis,):
        own = Joint(joint.suspect, joint.reference, joint.known, k, near=joint)
        free = np.ones(CHANGES, bool)
        free[OFFSET] = own.offset_known
        fit = own.fit(free)
        loss = float(np.sum(fit.losses)) * own.noise**2
        tried.append((loss, k, own, own.slides(fit)))
    _, k, own, slides = min(tried, key=lambda entry: entry[0])
    count = len(own.suspect)
    largest = np.array([np.abs(s).max() for s in slides])
    # The displacement of an episode against those of the reference, and against the noise of a single frame, which is
    # larger than the error of a knot. Both must be exceeded.
    ends = np.array([s[np.abs(s).argmax()] for s in slides])
    p = 2.0 * norm.sf(largest[:count].max() / own.noise) * count * len(tried)
    if len(own.reference) > 1:
        spread = float(np.sqrt(np.mean(ends[count:] ** 2)))
        of_reference = 2.0 * student.sf(largest[:count].max() / max(spread, 1e-6), len(own.reference)) * count
        p = max(p, of_reference * len(tried))
    return Slide(k, own, tuple(slides[:count]), largest[:count], min(1.0, float(p)))

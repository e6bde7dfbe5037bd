"""Where the search for a cause begins, and what counts as no change."""

from __future__ import annotations

import numpy as np
import pytest
from diagnose_cases import SMALL, SPLITS, bench_of, drag_trial
from report_cases import drag, recorded, rope

from pred_core.diagnose.judge import Bench, Screened, null_of
from pred_core.diagnose.search import Start, coordinates, starts
from pred_core.diagnose.trial import make_trial
from pred_core.effects import find_effect
from pred_core.identify.space import Candidate


def dragged(coefficient: float) -> Bench:
    """Recordings with drag [1/s], and a reference without."""
    twin = rope()
    suspect = recorded(twin, drag(coefficient=coefficient), SPLITS, seed=0, frames=40)
    return bench_of(twin, suspect, recorded(twin, (), SPLITS, seed=100, frames=40))


def test_a_search_for_a_strong_cause_begins_near_it() -> None:
    """Drag of 6 /s is 12 typical changes. A straight line from "off" goes three at most; followed while the loss falls
    it comes to ten. What it promises there is what is saved there, and much more than three save.
    """
    bench = dragged(6.0)
    trial = drag_trial(bench)
    (begin,) = starts(bench.fitted, trial, SMALL.places, np.random.default_rng(0))
    assert begin.z == pytest.approx([10.0])
    losses = bench.fitted.losses(trial.space, [trial.space.start(), begin.z, np.array([3.0])]).mean(axis=1)
    assert begin.promise == pytest.approx(losses[0] - losses[1], rel=1e-6)
    assert begin.promise > 1.5 * (losses[0] - losses[2])


def test_a_reference_that_was_never_there_says_nothing_of_a_place() -> None:
    """A ball a metre beside the rope changes nothing in the reference: no change is no ball, not that ball."""
    bench = dragged(1.5)
    trial = make_trial(bench.twin, (find_effect("obstacle"),))
    ball = find_effect("obstacle").extension(radius=(0.05,), center=(1.0, 1.0, 0.5))
    found, off = coordinates(trial.space, Candidate(bench.twin.physics, (ball,))), trial.space.start()
    assert found[trial.amplitudes[0]] > off[trial.amplitudes[0]]
    screened = Screened((find_effect("obstacle"),), trial, [Start(found, 0.0)], 0.0, off)
    assert null_of(bench, screened, found) == pytest.approx(off)

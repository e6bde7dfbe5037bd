"""What the data deny is absent; only what the motions could not show is not testable."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from diagnose_cases import SPLITS, bench_of
from report_cases import judged, recorded, rope

from pred_core.calibration import Calibration
from pred_core.diagnose.answer import not_testable_in
from pred_core.diagnose.evidence import ACTS
from pred_core.diagnose.gate import GateResult
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Bench, Screened, excitation, judge
from pred_core.diagnose.naming import why_not
from pred_core.diagnose.places import Start
from pred_core.diagnose.progress import Named, Progress, Round
from pred_core.effects import find_effect
from pred_core.twin import Twin

EVERY = len(SPLITS)
NOTHING = GateResult((), Calibration(), Calibration(), 3e-4, EVERY, 0, {}, ())


@pytest.fixture(scope="module")
def twin() -> Twin:
    return rope()


@pytest.fixture(scope="module")
def bench(twin: Twin) -> Bench:
    """A rope that swings above a table it does not reach, and lacks nothing."""
    suspect, reference = (recorded(twin, (), SPLITS, seed=seed, frames=40) for seed in (100, 200))
    return bench_of(twin, suspect, reference)


@pytest.mark.parametrize(
    ("id", "excited", "why"),
    [
        ("drag_linear", EVERY, "fitted to no change: it acts in 0 episodes only, though these motions excite it"),
        ("table_height", 0, "acts in 0 episodes only"),
    ],
)
def test_no_change_is_absent_where_a_change_would_be_seen(
    bench: Bench, tmp_path: Path, id: str, excited: int, why: str
) -> None:
    """Drag is fitted to nothing and acts nowhere, but 0.5 /s of it would be seen in every episode. A table that is 5 mm
    higher is as far from the rope as it was. From the journal it is the same.
    """
    trial = bench.trial((find_effect(id),))
    screened = Screened((find_effect(id),), trial, [Start(trial.space.start(), 1.0)], 1.0, trial.space.start())
    found, again = (judge(bench, screened, Journal(tmp_path / "journal.jsonl", {}), id) for _ in range(2))
    assert not found.acts.any() and found.excited == again.excited == excited
    progress = Progress(bench, Journal(None, {}), [bench.twin])
    assert why_not(found, 0.001, 10.0, 0.0, progress) == why
    progress.rounds = [Round(bench.standing(), 0.0, (), ((found, 0.001, why),))]
    said = f"these motions hardly excite it: a typical change of it moves 0 of {EVERY} episodes"
    assert not_testable_in(NOTHING, progress) == ({} if excited else {id: said})


def test_of_a_place_what_the_search_found_counts(bench: Bench) -> None:
    """A pull of nothing towards the middle of the swing would be seen if it were there; one 4 m away not."""
    trial = bench.trial((find_effect("attraction"),))
    seen = {}
    for x in (0.0, 4.0):
        z = trial.space.start()
        for n, knob in enumerate(trial.space.knobs):
            if ".center[" in knob.name:
                z[n] = knob.coordinate((x, 0.0, 0.5)[int(knob.name[-2])])
        seen[x] = int((excitation(bench.target, trial, z, trial.space.start()) > ACTS).sum())
    assert seen == {0.0: EVERY, 4.0: 0}


def test_few_episodes_at_a_place_do_not_make_it_untestable(bench: Bench) -> None:
    """An obstacle whose search ended where two episodes pass says nothing of where the others pass; a tilted gravity
    that two of six feel is hardly excited. What no episode feels is not testable, in a place or not.
    """
    few = dataclasses.replace(judged(bench.twin, "drag_linear", 1.5, 0.1, [1.0] * EVERY), acts=np.zeros(EVERY, bool))
    said = {}
    for id in ("obstacle", "gravity_offset"):
        for excited in (0, 2):
            one = dataclasses.replace(few, trial=bench.trial((find_effect(id),)), excited=excited)
            said[id, excited] = one.testable
            assert not one.excites
    assert said == {
        ("obstacle", 0): False, ("obstacle", 2): True, ("gravity_offset", 0): False, ("gravity_offset", 2): False
    }  # fmt: skip


def test_who_acts_is_not_asked_and_who_is_named_is_testable(bench: Bench) -> None:
    """A vote needs four episodes in which a cause acts, whatever its typical change would move; a name says enough."""
    six = judged(bench.twin, "drag_linear", 1.5, 0.1, [1.0] * EVERY)
    idle = dataclasses.replace(six, acts=np.arange(EVERY) < 3)
    assert six.testable and not idle.testable
    assert dataclasses.replace(idle, excited=4).testable and not dataclasses.replace(idle, excited=3).testable
    three = dataclasses.replace(idle, acts=np.ones(3, dtype=bool))
    assert three.testable, "of three episodes it acts in all"
    progress = Progress(bench, Journal(None, {}), [bench.twin])
    progress.rounds = [Round(bench.standing(), 0.0, (), ((idle, 0.001, "acts in 3 episodes only"),))]
    assert set(not_testable_in(NOTHING, progress)) == {"drag_linear"}
    progress.named = [Named(six, 0.001, (), 0.7, 1)]
    assert not_testable_in(NOTHING, progress) == {}

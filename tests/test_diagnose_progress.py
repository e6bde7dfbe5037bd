"""A user is told what is left, and no round begins that would end far beyond the time that was given."""

from __future__ import annotations

import dataclasses
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest
from diagnose_cases import SMALL, SPLITS
from report_cases import drag, recorded, rope

from pred_core.diagnose.effort import duration, say_effort, seconds_of
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.pace import Pace
from pred_core.diagnose.progress import Progress
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.rounds import one_round
from pred_core.diagnose.run import LATEST, OVER, diagnose
from pred_core.diagnose.sample import make_sample


def test_what_is_left_goes_by_the_pieces_that_took_time() -> None:
    """Ten pieces, the first four from the journal at once, then 3 s each: after two of these four are left, 12 s."""
    journal, now = Journal(None, {}), [100.0]
    pace = Pace(10, journal, lambda: now[0])
    journal.replayed += 4
    assert pace.left(4) == "", "nothing is known of the pace"
    now[0] += 6.0
    assert pace.left(6) == ", about 12 s left"
    assert pace.left(10) == ""


@pytest.mark.parametrize(
    ("passed", "took", "slower", "may"),
    [
        (110.0, 100.0, 1.0, True),  # a pair: 195 s in two rounds
        (234.0, 230.0, 1.0, False),  # it would end at 464 s; 375 s are allowed
        (180.0, 180.0, 1.0, True),  # 360 s
        (200.0, 200.0, 1.0, False),  # 400 s
        (250.0, 5.0, 1.0, False),  # less than a fifth is left, for the errors and the report
        (100.0, 50.0, 2.5, True),  # 225 s, within 240 s
        (100.0, 60.0, 2.5, False),  # 250 s: what is much slower is known badly
        (100.0, 100.0, 0.5, True),
    ],
)
def test_no_round_begins_that_would_end_far_too_late(passed: float, took: float, slower: float, may: bool) -> None:
    begin, needed = time.monotonic() - passed, 100.0
    roller = SimpleNamespace(usual=lambda: 0.5 * needed, demand=lambda candidate: slower * needed)
    twin = SimpleNamespace(physics=None, extensions=())  # what it needs grows with what was named
    bench: Any = SimpleNamespace(target=SimpleNamespace(roller=roller), twin=twin)
    deadline, latest = begin + 300.0 * LATEST, begin + 300.0 * (1.0 + OVER)
    progress = Progress(bench, cast(Journal, None), [], deadline, latest, took, needed)
    assert progress.time_for_another() == may


def test_the_first_round_always_ends_and_its_lines_say_what_is_left() -> None:
    """A second was given: one round, said to be long before it began, and what was not looked for is noted."""
    twin, lines = rope(), []
    config = dataclasses.replace(SMALL, seconds=1.0)
    suspect = recorded(twin, drag(), SPLITS, frames=40)
    found = diagnose(suspect, twin, recorded(twin, (), SPLITS, seed=100, frames=40), config, lines.append)
    assert found.causes[0].id == "drag_linear" and len(found.rounds) == 1
    assert lines[0].startswith("this will take long: about ") and "substeps in a period of 33.3 ms" in lines[0]
    assert any(line.startswith("round 1: ") and line.endswith("left of --seconds") for line in lines)
    screening = [line for line in lines if "screening" in line]
    assert len(screening) > 2 and all("about " in line and line.endswith("s left") for line in screening[1:-1])
    stopped = [n for n in found.notes if n.startswith("stopped after 1 rounds: no time for more in --seconds 1")]
    assert len(stopped) <= 1
    assert not any(line.startswith("round 2") for line in lines)


def test_a_later_round_that_takes_too_long_is_given_up_and_what_was_found_stands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What was named can make every rollout much slower: round 2 of a damped rope took 800 s, 115 were expected."""
    twin, lines = rope(), []
    suspect, known = recorded(twin, drag(), SPLITS, frames=40), recorded(twin, (), SPLITS, seed=100, frames=40)

    def late(progress: Progress, tell: Any, number: int) -> bool:
        progress.latest = time.monotonic() - 1.0 if number else progress.latest
        return one_round(progress, tell, number)

    monkeypatch.setattr("pred_core.diagnose.run.one_round", late)
    monkeypatch.setattr("pred_core.diagnose.run.something_left", lambda progress: True)
    found = diagnose(suspect, twin, known, SMALL, lines.append)
    assert [c.id for c in found.causes] == ["drag_linear"] and len(found.rounds) == 1
    assert "round 2 was given up: it takes longer than --seconds allow" in found.notes
    assert any(line.startswith("round 2: ") for line in lines) and not any("round 3" in line for line in lines)


def test_a_twin_that_needs_many_substeps_is_said_to_take_long() -> None:
    """A hundred thousand times as stiff: the estimate grows as the substeps, and no rollout of the usual kind is
    needed for it. What is done in time is not mentioned."""
    twin, lines = rope(), []
    stiff = twin.replace(physics=dataclasses.replace(twin.physics, stiffness=1e5))
    episodes = recorded(twin, (), ("train",) * 2, frames=40)
    plain, slow = (Roller(t, make_sample(episodes, t, 1.0)) for t in (twin, stiff))
    times = slow.usual() / plain.usual()
    assert times > 30.0
    say_effort(plain, dataclasses.replace(SMALL, seconds=86400.0), lines.append)
    assert lines == []
    begin = time.monotonic()
    say_effort(slow, dataclasses.replace(SMALL, seconds=1.0), lines.append)
    assert time.monotonic() - begin < 5.0
    assert len(lines) == 1 and f"stiffness of 100000 N asks for {slow.usual():.0f} substeps" in lines[0]
    assert seconds_of(slow) > 5.0 * seconds_of(plain)


def test_durations_are_said_in_the_unit_of_a_person() -> None:
    assert [duration(s) for s in (40.0, 720.0, 12240.0)] == ["40 s", "12 min", "3.4 h"]

"""What a diagnosis says is true: of errors that do not fall, intervals that nobody measured, shares, odds, the base."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from diagnose_cases import bench_of, quiet
from report_cases import LINEAR, answer, drag, judged, recorded, rope, with_errors

from pred_core.calibration import Calibration
from pred_core.diagnose.answer import (
    CHEAP,
    Study,
    closed_by_gate,
    explained_by,
    floor_of,
    outcome_of,
    refining_of,
)
from pred_core.diagnose.answer import answer as answer_of
from pred_core.diagnose.causes import causes_of, evidence_of
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.errors import episode_errors
from pred_core.diagnose.gate import GateCause, GateResult
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.progress import Named, Progress
from pred_core.diagnose.ranking import UNSEEN, explains, nothing, ranking
from pred_core.diagnose.refining import refining_said
from pred_core.diagnose.result import Cause, Diagnosis, Value
from pred_core.diagnose.said import called, confusions, sentence, unmoved, unproven, without_interval
from pred_core.diagnose.sample import make_sample
from pred_core.diagnose.seen import seen_only
from pred_core.effects import LIBRARY, find_effect
from pred_core.twin import Twin
from pred_core.types import Episode

SPLITS = ("train",) * 3 + ("test",) * 2


@pytest.fixture(scope="module")
def twin() -> Twin:
    return rope()


@pytest.fixture(scope="module")
def dragged(twin: Twin) -> list[Episode]:
    return recorded(twin, drag(), SPLITS, frames=40)


def with_error(d: Diagnosis, base: Sequence[float], extended: Sequence[float]) -> Diagnosis:
    return dataclasses.replace(d, errors=with_errors(d, base, extended, None))


def gate_of(*causes: GateCause) -> GateResult:
    return GateResult(causes, Calibration(), Calibration(), 3e-4, 12, 0, {}, ())


def measured(id: str, effect_mm: float = 1.0, p: float = 0.01) -> GateCause:
    """A cause that the gate found."""
    return GateCause(id, True, True, "12 episodes", "s", {id: (0.02,)}, {id: ((0.01, 0.03),)}, p, p, effect_mm)


def progress_of(groups: Sequence[int], *named: Named) -> Progress:
    """As far as causes are read from it; `groups`: recordings, of train episodes all."""
    sample = SimpleNamespace(groups=np.array(groups), episodes=len(groups))
    bench = SimpleNamespace(
        target=SimpleNamespace(roller=SimpleNamespace(sample=sample)), train=np.ones(len(groups), bool), reference=None,
        config=DiagnoseConfig(),
    )  # fmt: skip
    return cast(Progress, SimpleNamespace(bench=bench, named=list(named), rounds=[], unknown=False))


def drag_named(twin: Twin, low: float, high: float) -> Named:
    one = judged(twin, "drag_linear", LINEAR, 0.1, [1.0] * 6)
    return Named(dataclasses.replace(one, intervals=dict.fromkeys(one.intervals, (low, high))), 0.01, (), 1.0, 0)


@pytest.mark.parametrize(
    ("base", "extended", "said"),
    [
        ((10.0, 14.0), (5.0, 6.0), "with it the held-out error falls from 12.0 to 5.5 mm, 2 of 2 episodes"),
        ((10.0, 12.6), (11.8, 21.0), "with it the held-out error rises from 11.3 to 16.4 mm, lower in 0 of 2 episodes"),
        ((4.12, 4.12), (4.08, 4.14), "with it the held-out error stays at 4.1 mm, lower in 1 of 2 episodes"),
    ],
)
def test_the_sentence_says_which_way_the_error_goes(
    twin: Twin, dragged: list[Episode], base: Sequence[float], extended: Sequence[float], said: str
) -> None:
    """In the one digit it shows: 4.12 to 4.11 is not a fall from 4.1 to 4.1."""
    d = with_error(answer(twin, dragged), base, extended)
    assert said in sentence(d)
    note = unproven(d.causes, d.errors, 1.6)
    assert bool(note) == ("falls" not in said)
    if note:
        assert "judged on windows of 1.6 s" in note and "whole held-out episodes the error did not fall" in note
        assert "should not be used for prediction unchecked" in note


def test_an_error_that_nothing_could_change_neither_falls_nor_rises(twin: Twin, dragged: list[Episode]) -> None:
    """Where nothing is named the extended twin is the base: 101.3 mm before and after is no fall to 101.3 mm."""
    d = with_error(answer(twin, dragged, "unknown"), (101.3, 101.3), (101.3, 101.3))
    assert sentence(d).endswith("no candidate explains; the held-out error is 101.3 mm.")
    assert unproven((), d.errors, 1.6) == ""


def test_a_sensor_cause_was_not_judged_on_windows(twin: Twin, dragged: list[Episode]) -> None:
    d = with_error(answer(twin, dragged), (3.4, 3.4), (3.4, 3.4))
    causes = [dataclasses.replace(c, measured=True) for c in d.causes]
    assert unproven(causes, d.errors, 1.6).startswith("what was found was measured without the simulation; on whole")


@pytest.mark.parametrize(
    ("groups", "low", "high", "known"),
    [
        ((0, 0, 1, 1, 2, 2), 1.2, 1.8, True),
        ((0,) * 6, 0.0, 50.0, False),  # one recording: the bounds of the search
        ((0,) * 6, 1.2, 1.8, False),  # one recording, whatever stands there
        ((0, 0, 0, 1, 1, 1), 0.0, 50.0, False),  # so wide that it ends with the search, on both sides
    ],
)
def test_what_only_bounds_the_search_is_called_no_interval(
    twin: Twin, dragged: list[Episode], groups: Sequence[int], low: float, high: float, known: bool
) -> None:
    """The search for drag goes from 0 to 50 /s. `diagnosis.json` has null, and a note says so."""
    progress = progress_of(groups, drag_named(twin, low, high))
    causes = causes_of(gate_of(), progress, {"drag_linear": 0.9}, {})
    value = causes[0].parameters["coefficient"]
    assert (value.low, value.high, value.interval) == (low, high, known)
    d = dataclasses.replace(answer(twin, dragged), causes=causes)
    assert ("1.5 1/s (no interval)" in sentence(d)) == (not known)
    assert ("1.5 1/s [1.2, 1.8]" in sentence(d)) == known
    assert ("no interval for air drag (coefficient)" in without_interval(causes)) == (not known)
    told = d.to_json()["causes"][0]["parameters"]["coefficient"]
    assert (told["low"], told["high"]) == ((low, high) if known else (None, None))
    kept = evidence_of(drag()[0], progress).evidence["interval"]["drag_linear.coefficient[0]"]
    assert kept == ([low, high] if known else None)


# The parameter that a person would ask for, of every law that has several. Strengths stand first; of a wind that is a
# drag, which nobody calls its strength.
MAIN = {
    "drag_power": "1/s", "bending_hysteresis": "1", "wind": "m/s", "attraction": "m/s^2", "tether": "N/m",
    "obstacle": "m", "friction_power": "1", "friction_patch": "1", "bending_region": "1", "grip_slip": "1/N",
    "rest_curvature": "1", "camera_scale": "1", "camera_rotation": "rad",
}  # fmt: skip


def test_a_cause_is_called_by_the_number_a_person_would_ask_for() -> None:
    several = {e.id: e for e in LIBRARY.values() if len(e.parameters) > 1}
    assert set(several) == set(MAIN), "a new law with several parameters: which one is said?"
    for id, effect in several.items():
        shown = next(q for q in effect.parameters if q.name == (effect.headline or effect.parameters[0].name))
        assert shown.unit == MAIN[id]
    assert all(e.headline in ("", *(q.name for q in e.parameters)) for e in LIBRARY.values())


def test_a_wind_is_said_in_metres_a_second() -> None:
    values = {
        "coefficient": Value(0.491, "1/m", 0.4, 0.6), "velocity[0]": Value(3.02, "m/s", 2.0, 4.0),
        "velocity[1]": Value(-0.5, "m/s", -1.0, 0.0), "along": Value(0.1, "1", 0.0, 0.2),
    }  # fmt: skip
    assert called(Cause("wind", "wind", 0.9, values)) == "wind: (3.02, -0.5) m/s"
    slip = {"weakness": Value(10.1, "1/N", 4.8, 15.5), "damping": Value(5.0, "N s/m", 1.0, 9.0)}
    assert called(Cause("grip_slip", "slip", 0.9, slip)) == "slip in the gripper: 10.1 1/N [4.8, 15.5]"


def test_one_episode_gives_the_gain_no_interval(twin: Twin, dragged: list[Episode]) -> None:
    """No 95 % interval of width 0; with two episodes it has one."""
    for count, known in ((1, False), (2, True)):
        d = with_error(answer(twin, dragged), (12.0, 14.0)[:count], (8.0, 9.0)[:count])
        gain = d.to_json()["gain"]
        assert (gain["low_mm"] is not None) == (gain["high_mm"] is not None) == known
        assert gain["mean_mm"] == pytest.approx(4.0 if count == 1 else 4.5)


def test_a_correction_closes_what_it_takes_away(twin: Twin, dragged: list[Episode]) -> None:
    """12 mm over a floor of 2 are 10 in excess: 4 mm are 40 % of it, -1 mm none. Under the floor there is no share."""
    gate, d = gate_of(measured("delay"), measured("camera_scale"), measured("table_height")), answer(twin, dragged)
    named = {"delay": 4.0, "camera_scale": -1.0}
    shares = closed_by_gate(gate, named, with_errors(d, (12.0,), (8.0,), 2.0))
    assert shares == {"delay": pytest.approx(0.4), "camera_scale": 0.0}
    assert closed_by_gate(gate, named, with_errors(d, (12.0,), (8.0,), 15.0)) == {"delay": None, "camera_scale": None}
    causes = causes_of(gate, progress_of((0, 1)), dict.fromkeys(named, 0.9), shares)
    assert [c.closed for c in causes] == [pytest.approx(0.4), 0.0] and all(c.measured for c in causes)


def test_a_p_value_is_not_the_probability_of_nothing() -> None:
    """p = 0.031 of a delay: even odds before and densities 1 and 0.0427 x 0.031^-0.957 = 1.19 make 0.54, not 0.98."""
    for p, probability in ((0.031, 0.543), (0.0001, 0.997)):
        rows = ranking(gate_of(measured("delay", p=p)), progress_of((0, 1)))
        found = next(r for r in rows if r.id == "delay")
        assert found.probability == pytest.approx(probability, abs=2e-3) == 1.0 - nothing(p)


def test_only_what_was_judged_is_told_apart(twin: Twin, dragged: list[Episode]) -> None:
    """Of what is often taken for drag, quadratic drag was fitted and wind only screened. Mass along the rope, often
    taken for mass at its tip, was no candidate; a delay that these motions cannot show is not told apart either.
    """
    d = answer(twin, dragged)
    told, screened, no = "Told apart here", "only screened", "not tried here, or not testable"
    said = confusions(d, d.causes[0])
    assert said[told][0] == "drag_quadratic" and said[screened] == ["wind"]
    assert "friction_viscous" in said[no], "nothing touches a table"
    tip = dataclasses.replace(d.causes[0], id="tip_mass")
    assert confusions(d, tip)[no] == ["mass_gradient", "mass_profile"]
    hardly = dataclasses.replace(d, not_testable={"drag_quadratic": "acts in 2 episodes only"})
    assert "drag_quadratic" in confusions(hardly, d.causes[0])[no]
    slip = dataclasses.replace(d.causes[0], id="grip_slip")  # often taken for an offset of the gripper
    assert "gripper_offset" in confusions(d, slip)[no]
    tested = dataclasses.replace(d, gate=gate_of(GateCause("gripper_offset", False, True, "small")), not_testable={})
    assert "gripper_offset" in confusions(tested, slip)[told]
    seen = dataclasses.replace(d, gate=gate_of(measured("gripper_offset")), not_testable={})
    assert "gripper_offset" not in confusions(seen, slip)[told], "the gate found it"


def test_all_causes_must_hold(twin: Twin, dragged: list[Episode]) -> None:
    d = answer(twin, dragged)
    other = Cause("wind", "wind", 0.7, {}, False, 0.3, 0.04)
    d = dataclasses.replace(d, causes=(*d.causes, other))
    assert d.p_adjusted == d.to_json()["gain"]["p_adjusted"] == 0.04
    assert dataclasses.replace(d, causes=()).p_adjusted == 1.0


def test_what_the_base_is_and_what_refining_changed(twin: Twin, dragged: list[Episode]) -> None:
    """The given twin has the drag and errs by noise alone; the base lost it. Where a replay takes long, words do."""
    given = twin.replace(extensions=drag())
    lost = twin.replace(extensions=drag(coefficient=0.0))
    target = SimpleNamespace(roller=SimpleNamespace(sample=make_sample(dragged, twin, 1.0)))
    bench: Any = SimpleNamespace(reference=object(), config=DiagnoseConfig(), twin=lost, target=target)
    study = Study(tuple(dragged), tuple(dragged), (), given, gate_of(), bench, int(dragged[0].stamps[0]))
    test = [e for e in dragged if e.split == "test"]
    errors = dataclasses.replace(answer(twin, dragged).errors, base=episode_errors(lost, test))
    before, after = episode_errors(given, test).mean, errors.base.mean
    assert before < 0.5 * after
    text = refining_said(refining_of(study, errors, 0.1), "test")
    assert text.startswith("base: your twin refined on the reference, not as it was given")
    moved = "(coefficient of drag linear 1.5 to 0 1/s)"
    assert text.endswith(f": on the test episodes {before:.1f} mm as given, {after:.1f} mm refined {moved}")
    assert refining_said(refining_of(study, errors, 2.0 * CHEAP), "test") == f"{text[: text.index(': on')]} {moved}"
    bench.reference = None
    assert "refined on the train episodes" in refining_said(refining_of(study, errors, 2.0 * CHEAP), "test")


def delay_of(closed: float | None) -> Cause:
    """79.9 ms, as the gate measured them."""
    value = Value(0.0799, "s", 0.0796, 0.0801)
    return Cause("delay", "delay", 0.9999, {"delay": value}, True, closed, 1e-46)


@pytest.mark.parametrize(
    ("causes", "cold", "outcome"),
    [
        ((delay_of(0.58),), False, "named"),
        ((delay_of(0.29),), False, "unknown"),
        ((delay_of(None),), False, "unknown"),  # no excess to take a share of
        ((delay_of(0.58),), True, "unknown"),  # without a reference 60 % are asked for
        ((delay_of(0.61),), True, "named"),
        ((delay_of(0.2), dataclasses.replace(delay_of(0.15), id="camera_scale")), False, "named"),
        ((delay_of(0.2), Cause("wind", "wind", 0.7, {}, False, 0.15)), False, "named"),  # 0.2 + 0.8 x 0.15 = 0.32
        ((delay_of(0.2), Cause("wind", "wind", 0.7, {}, False, 0.10)), False, "unknown"),  # 0.28
        ((Cause("wind", "wind", 0.3, {}, False, 0.34),), False, "unknown"),
        ((Cause("wind", "wind", 0.6, {}, False, 0.46),), False, "named"),
        ((), False, "unknown"),
    ],
)
def test_what_was_measured_counts_as_explained(causes: tuple[Cause, ...], cold: bool, outcome: str) -> None:
    """Where something is left, what was measured must explain 30 % of the excess for a name, by sensor causes as by
    physics; physics alone 45 %, from where it is more probable than something unknown."""
    assert explains(0.45) == 0.5
    progress: Any = progress_of((0, 1))
    progress.unknown = True
    progress.bench.reference = None if cold else object()
    assert outcome_of(causes, progress) == outcome
    assert 0.0 <= explained_by(causes) <= 1.0


def test_an_episode_that_nothing_named_makes_better_is_told(twin: Twin, dragged: list[Episode]) -> None:
    """Four test episodes, 26.5 to 6.7 mm on average, and one of them stays at 18.9 of 19.0 mm."""
    d = with_error(answer(twin, dragged), (30.0, 28.0, 29.0, 19.0), (2.5, 2.6, 2.8, 18.9))
    assert unmoved(d.causes, d.errors) == "not explained by what was named: ep3 (18.9 of 19.0 mm left)"
    assert unmoved((), d.errors) == ""
    d = with_error(d, (30.0, 28.0, 29.0, 60.0), (2.5, 2.6, 2.8, 18.9))
    assert unmoved(d.causes, d.errors) == "", "better by two thirds"


def test_what_only_the_gate_saw_is_not_nothing(twin: Twin, dragged: list[Episode]) -> None:
    """Slip of 35 mm in the tracks of three of twelve episodes that no candidate has the name of is said; in one it may
    be the track of the jaws. Where a table lies is known from a reference only."""
    slides = {f"ep{n}": (0.0, 0.035 if n < 3 else 0.001) for n in range(12)}
    gate = dataclasses.replace(gate_of(measured("grip_slip", 35.0), measured("delay")), slides=slides)
    once = dataclasses.replace(gate, slides={**slides, "ep0": (0.0,), "ep1": (0.002,)})
    cold, known = progress_of((0, 1)), progress_of((0, 1))
    known.bench.reference = object()  # type: ignore[assignment]
    seen = seen_only(gate, cold)
    assert seen == {"grip_slip": 35.0} and not seen_only(once, cold)
    table = gate_of(measured("table_height", 3.0))
    assert not seen_only(table, cold) and seen_only(table, known) == {"table_height": 3.0}
    trial = SimpleNamespace(family="slip", ids=("grip_slip",))
    named: Any = SimpleNamespace(judged=SimpleNamespace(trial=trial))
    assert not seen_only(gate, progress_of((0, 1), named))
    d = dataclasses.replace(answer(twin, dragged), causes=(), outcome="unknown", seen=seen)
    assert "Seen in the tracks, and named by no candidate: slip in the gripper, 35.0 mm" in sentence(d)


def test_a_number_that_was_measured_is_said_whatever_is_left(twin: Twin, dragged: list[Episode]) -> None:
    """Named with a rest, unknown, or with a twin that is of no use: the delay stands there with its interval."""
    d = with_error(dataclasses.replace(answer(twin, dragged), causes=(delay_of(0.58),)), (38.1,), (20.9,))
    said = "a delay of the tracks: 0.0799 s [0.0796, 0.0801]"
    named = sentence(dataclasses.replace(d, more=True))
    assert named.startswith(f"Your simulation lacks {said}; with it the held-out error falls from 38.1 to 20.9 mm")
    assert named.endswith("Something else is left that no candidate explains.")
    unknown = dataclasses.replace(d, outcome="unknown", more=True)
    assert f"something that no candidate explains ({said} explains a part); the" in sentence(unknown)
    poor = sentence(dataclasses.replace(unknown, explained=0.2))
    assert "identify it anew" in poor and poor.endswith(f"Measured without it: {said}.")


def test_a_sensor_cause_says_nothing_of_what_is_left() -> None:
    """A delay with p 1e-46 and a base whose misfit nothing explains: P(unknown) stays what it is without the delay."""
    progress: Any = progress_of((0, 1))
    for unknown in (True, False):
        progress.unknown = unknown
        alone, beside = (
            {r.id: r.probability for r in ranking(gate_of(*causes), progress)} for causes in ((), (measured("delay"),))
        )
        assert beside["unknown"] == alone["unknown"] == pytest.approx(1.0 - (UNSEEN if unknown else nothing(1.0)))
        assert beside["none"] == 0.0 < alone["none"]
        assert beside["delay"] == 1.0 - nothing(0.01)


def test_outcome_rest_ranking_and_budget_do_not_contradict_each_other(twin: Twin, dragged: list[Episode]) -> None:
    """Tracks that are two frames late, of a rope with drag that no candidate was allowed to explain."""
    late = [
        dataclasses.replace(
            e, tracks=dataclasses.replace(e.tracks, position=np.concatenate((e.position[:1], e.position[:1],
                                                                             e.position[:-2]))))
        for e in dragged
    ]  # fmt: skip
    bench = bench_of(twin, dragged, recorded(twin, (), SPLITS, seed=100, frames=40))
    study = Study(tuple(late), tuple(dragged), (), twin, gate_of(measured("delay", p=1e-9)), bench,
                  int(dragged[0].stamps[0]))  # fmt: skip
    for unknown in (True, False):
        progress = Progress(bench, Journal(None, {}), [bench.twin], unknown=unknown)
        d = answer_of(study, progress, 0.0, quiet)
        j = d.to_json()
        assert d.causes[0].id == "delay" and (d.causes[0].closed or 0.0) > 0.3
        assert j["outcome"] == "named" and j["unexplained_rest"] == unknown
        assert ("Something else is left" in j["sentence"]) == unknown
        rows = {r["id"]: r["probability"] for r in j["ranking"]}
        assert (rows["unknown"] > 0.5) == unknown and rows["none"] == 0.0


def test_the_floor_is_on_the_clock_of_the_reference(twin: Twin) -> None:
    """A twin that carries a drift: its test episodes are 30 s into the reference's session, whatever the suspect's."""
    drift = twin.replace(extensions=(find_effect("length_drift").extension(rate=(0.2,)),))
    known = recorded(twin, (), SPLITS, frames=40)
    begin = int(known[0].stamps[0])
    bench: Any = SimpleNamespace(reference_twin=drift)
    study = Study((), (), tuple(known), twin, gate_of(), bench, begin + 10**12)
    late = [e for e in known if e.split == "test"]
    assert floor_of(study, "test") == episode_errors(drift, late, begin).mean > 3.0 * episode_errors(drift, late).mean
    assert floor_of(study, "ood") is None


def test_a_law_that_the_data_contradict_is_no_name(twin: Twin, dragged: list[Episode]) -> None:
    """The first cause decides: where its law is only the nearest one the answer is unknown; a later one is marked."""
    d = answer(twin, dragged)
    drag_cause = dataclasses.replace(d.causes[0], contradicted="its power is 1.50 [1.41, 1.58], not 2 (p 0.001)")
    tip = Cause("tip_mass", "mass", 0.7, {}, False, 0.3, 0.04)
    progress = progress_of((0, 1))
    for causes, outcome in (((drag_cause, tip), "unknown"), ((tip, drag_cause), "named"), ((tip,), "named")):
        assert outcome_of(causes, progress) == outcome
        said = sentence(dataclasses.replace(d, causes=causes, outcome=outcome))
        if outcome == "unknown":
            assert "whose law no candidate has. The nearest is air drag: 1.5 1/s" in said
            assert "but its power is 1.50 [1.41, 1.58], not 2" in said and "Besides it lacks mass at the tip." in said
        else:
            assert ("(nearly: its power is 1.50" in said) == (drag_cause in causes)

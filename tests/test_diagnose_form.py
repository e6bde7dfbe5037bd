"""The form of a law: with a free power it is the same where that is the law's own, and tells another one from it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from diagnose_cases import bench_of, quiet
from report_cases import recorded, rope
from springmass_cases import line, state_of, still, zigzag

from pred_core.diagnose.form import check_forms, check_table
from pred_core.diagnose.gate_result import GateCause, GateResult
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import judge, rng_of, screen
from pred_core.diagnose.progress import Named, Progress, Round
from pred_core.diagnose.ranking import UNSEEN, ranking
from pred_core.diagnose.rounds import extend
from pred_core.diagnose.trial import NOT_A_NAME
from pred_core.effects import LIBRARY, find_effect
from pred_core.effects.algebra import Code, Traced, log
from pred_core.springmass import SpringMass
from pred_core.twin import Calibration, Extension
from pred_core.types import Physics, Scene

ON = {"drag_linear": 1.7, "drag_quadratic": 2.3, "friction_scale": 0.8, "friction_viscous": 4.0}
OF_A_FORM = sorted(id for id, effect in LIBRARY.items() if effect.form)
SPLITS = ("train",) * 8 + ("test",) * 2


def gate(*causes: GateCause) -> GateResult:
    return GateResult(causes, Calibration(), Calibration(), 7e-4, 10, 10, {}, ())


def named(truth: Extension, id: str, journal: Journal | None = None) -> Progress:
    """A diagnosis that has just named `id`, of a rope that moves by `truth`."""
    twin = rope()
    suspect = recorded(twin, (truth,), SPLITS, seed=0, frames=60, size=0.16)
    bench = bench_of(twin, suspect, recorded(twin, (), SPLITS, seed=100, frames=60, size=0.16))
    progress = Progress(bench, journal or Journal(None, {}), [bench.twin])
    screened = screen(bench, (find_effect(id),), rng_of(0, id), progress.journal, "screen")
    found = judge(bench, screened, progress.journal, "fit")
    progress.rounds.append(Round(bench.standing(), 0.1, ((id, 1.0),), ((found, 0.001, ""),)))
    progress.add(Named(found, 0.001, (), 0.9, 0), extend(bench, found))
    return progress


@pytest.mark.parametrize("id", OF_A_FORM)
def test_a_law_written_in_its_form_is_the_same_law(id: str) -> None:
    effect, physics = LIBRARY[id], Physics(stiffness=60.0, damping=0.1, ground_friction=0.4)
    law = effect.extension(**{effect.parameters[0].name: ON[id]})
    same = Extension(effect.form, 1, effect.in_form(law.parameters, physics))
    ends = []
    for extensions in ([law], [same], []):
        start = zigzag(13, 0.05, 40.0) + np.array([0.0, 0.0, 0.01])
        sim = SpringMass(line(13, 0.6), physics, Scene(ground=0.0), extensions=extensions, substeps=20)
        state = sim.start(state_of(start, 0.6), still(start[:1]))
        x, _ = sim.rollout_states(state, still(start[:1], 30))
        ends.append(x[-1])
    assert float((ends[0] - ends[2]).abs().max()) > 1e-3, "the law does nothing here"
    assert float((ends[0] - ends[1]).abs().max()) < 1e-5


def test_a_form_is_no_candidate_of_its_own() -> None:
    assert {LIBRARY[id].form for id in OF_A_FORM} <= set(NOT_A_NAME)


@pytest.mark.parametrize("id", ["drag_linear", "drag_quadratic"])
def test_another_power_than_the_laws_contradicts_it(id: str) -> None:
    truth = LIBRARY["drag_power"].extension(coefficient=3.0, power=1.5)
    progress = named(truth, id)
    before = progress.bench.standing().mean()
    check_forms(progress, quiet)
    (found,) = progress.named
    assert found.judged.trial.ids == ("drag_power",) and found.judged.trial.family == "drag"
    assert found.judged.values["drag_power.power[0]"] == pytest.approx(1.5, abs=0.1)
    low, high = found.judged.intervals["drag_power.power[0]"]
    assert low < 1.5 < high
    assert found.contradicted.startswith("its power is 1.5")
    assert progress.bench.standing().mean() < before
    assert [e.id for e in progress.twins[-1].extensions] == ["drag_power"]
    rows = {r.id: r for r in ranking(gate(), progress)}
    assert rows["drag_power"].probability == UNSEEN and rows["unknown"].probability > 0.9
    assert rows[id].rejected == found.contradicted


@pytest.mark.parametrize(("id", "coefficient"), [("drag_linear", 3.0), ("drag_quadratic", 3.0)])
def test_a_law_that_is_right_stays(id: str, coefficient: float) -> None:
    progress = named(LIBRARY[id].extension(coefficient=coefficient), id)
    before, bench = list(progress.named), progress.bench
    check_forms(progress, quiet)
    assert progress.named == before and progress.bench is bench


def test_a_check_that_was_interrupted_goes_on_from_the_journal() -> None:
    journal, truth = Journal(None, {}), LIBRARY["drag_power"].extension(coefficient=3.0, power=1.5)
    first = named(truth, "drag_linear", journal)
    check_forms(first, quiet)
    done = journal.replayed
    again = named(truth, "drag_linear", journal)
    check_forms(again, quiet)
    assert journal.replayed - done == 4  # screening, fit, both laws
    assert np.array_equal(again.named[0].judged.z, first.named[0].judged.z)


def test_a_plane_is_not_the_law_of_an_uneven_table() -> None:
    progress = named(LIBRARY["drag_linear"].extension(coefficient=3.0), "drag_linear")
    relief = GateCause("table_relief", True, True, "particles rest 0.92 mm off it, in the reference 0.29 mm")
    check_table(progress, gate(relief))
    assert not progress.named[0].contradicted and not progress.unknown  # drag says nothing of a table

    flat = dataclasses.replace(progress.named[0], judged=dataclasses.replace(
        progress.named[0].judged, trial=dataclasses.replace(progress.named[0].judged.trial, family="table")
    ))  # fmt: skip
    progress.named = [flat]
    check_table(progress, gate(dataclasses.replace(relief, accepted=False)))
    assert not progress.named[0].contradicted
    check_table(progress, gate(relief))
    assert "0.92 mm" in progress.named[0].contradicted

    progress.named = []
    check_table(progress, gate(relief))
    assert progress.unknown  # it was seen, and nothing explains it


def test_torch_and_the_simulator_have_one_logarithm() -> None:
    assert float(log(torch.tensor(2.5))) == pytest.approx(np.log(2.5))
    code = Code("t")
    assert isinstance(log(Traced(code, "a")), Traced) and "lane_log(a)" in code.lines[0]

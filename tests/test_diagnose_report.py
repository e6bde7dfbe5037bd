"""The report of a diagnosis: where its map puts an error, what its budget adds up to, what it always has."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from report_cases import HOME, answer, drag, recorded, rope, with_errors

from pred_core.calibration import Calibration
from pred_core.diagnose import pictures
from pred_core.diagnose.chosen import chosen_of
from pred_core.diagnose.errors import episode_errors, gain_of
from pred_core.diagnose.gate import GateCause
from pred_core.diagnose.map import FEATURES, Replay, conditional, edges_of, from_above, grid_of, replay
from pred_core.diagnose.next_motion import propose
from pred_core.diagnose.pictures import evidence, whole_of
from pred_core.diagnose.report import with_clock, write_report
from pred_core.diagnose.report_parts import budget_rows, span_of
from pred_core.diagnose.result import Cause, Diagnosis, Errors
from pred_core.effects import find_effect
from pred_core.twin import Twin
from pred_core.types import Episode

SPLITS = ("train",) * 5 + ("test",) * 3
SECTIONS = (
    "Where and when the error sits", "Evidence: what explains it, and what does not", "{before}",
    "Errors by episode", "Error budget", "Measured without the simulation", "What cannot be told apart",
    "The motion that would tell it apart", "With and without a network", "How it was made",
)  # fmt: skip


@pytest.fixture(scope="module")
def twin() -> Twin:
    return rope()


@pytest.fixture(scope="module")
def dragged(twin: Twin) -> list[Episode]:
    return recorded(twin, drag(), SPLITS)


def by_hand(size: np.ndarray, feature: np.ndarray, seen: np.ndarray) -> Replay:
    """A replay whose error has these sizes [mm] (E, K, N), along x, one window an episode."""
    error = np.zeros((*size.shape, 3))
    error[..., 0] = size * 1e-3
    return Replay("base", error, seen, np.arange(len(size)), len(size), np.zeros_like(error), {"along": feature})


def test_the_mean_in_a_bin_is_the_mean_of_its_samples_over_all_episodes() -> None:
    """Particles at 0 and 1: 1 mm at the first, 4 and 8 mm at the second, of which one episode shows one frame only:
    (3 * 4 + 1 * 8) / 4 = 5 mm over all samples. Episodes of 4 and of 8 mm bound every draw of episodes.
    """
    size = np.array([[[1.0, 4.0]] * 3, [[1.0, 8.0]] * 3])
    seen = np.ones((2, 3, 2), dtype=bool)
    seen[1, 1:, 1] = False
    arc = np.broadcast_to(np.array([0.0, 1.0]), size.shape)
    rows = by_hand(size, arc, seen)
    curve = conditional(rows, "along", edges_of(rows, "along"), np.random.default_rng(0))
    assert np.allclose(curve.mean, (1.0, 5.0))
    assert curve.low[0] == curve.high[0] == pytest.approx(1.0)
    assert curve.low[1] == pytest.approx(4.0) and curve.high[1] == pytest.approx(8.0)


def test_a_bin_that_few_episodes_reach_is_not_drawn() -> None:
    """Four episodes; the second particle is seen in two of them: fewer than the three a bin needs."""
    size, arc = np.ones((4, 2, 2)), np.broadcast_to(np.array([0.0, 1.0]), (4, 2, 2))
    seen = np.ones((4, 2, 2), dtype=bool)
    seen[:2, :, 1] = False
    rows = by_hand(size, arc, seen)
    curve = conditional(rows, "along", edges_of(rows, "along"), np.random.default_rng(0))
    assert curve.mean[0] == pytest.approx(1.0) and np.isnan(curve.mean[1])


def test_drag_that_is_missing_shows_at_speed_at_the_free_end_and_late(twin: Twin, dragged: list[Episode]) -> None:
    """What lacks drag is wrong where the object is fast, far from the gripper, and some time after a start; with the
    drag in the twin only noise is left (0.3 mm an axis, and the start has it too): nowhere a fifth of the base's worst.
    """
    base = replay("base", twin, dragged, Calibration())
    known = replay("extended", twin.replace(extensions=drag()), dragged, Calibration())
    for key in ("speed", "along", "distance", "since"):
        edges = edges_of(base, key)
        mean = conditional(base, key, edges, np.random.default_rng(0)).mean
        assert np.nanmean(mean[-2:]) > 2.0 * np.nanmean(mean[:2]), key
        assert np.nanmax(conditional(known, key, edges, np.random.default_rng(0)).mean) < 0.2 * np.nanmax(mean)
    assert set(base.features) == {f.key for f in FEATURES}


def test_the_map_from_above_points_to_a_planted_place(twin: Twin) -> None:
    """A force towards a place that the rope swings past: the arrows around it point towards it (mean cosine above 0.5),
    and the error beside it is larger than far away.
    """
    centre = HOME + (0.09, 0.0, -0.4)
    pulled = find_effect("attraction").extension(strength=(1.5,), center=tuple(centre.tolist()), range=(0.08,))
    episodes = recorded(twin, (pulled,), ("train",) * 8, seed=40)
    base = replay("base", twin, episodes, Calibration())
    x, y = grid_of([base])
    seen = from_above(base, x, y)
    xs, ys = np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2)
    towards = np.stack((centre[0] - xs, centre[1] - ys), axis=-1)
    far = np.linalg.norm(towards, axis=-1)
    known = np.isfinite(seen.mean) & (far > x[1] - x[0])
    near = known & (far < 0.10)
    cosine = (seen.pull * towards).sum(-1) / np.linalg.norm(seen.pull, axis=-1) / far
    assert near.sum() >= 5 and np.average(cosine[near], weights=np.linalg.norm(seen.pull, axis=-1)[near]) > 0.5
    assert np.nanmean(seen.mean[near]) > 1.5 * np.nanmean(seen.mean[known & (far > 0.15)])


@pytest.mark.parametrize(
    ("base", "extended", "floor", "named"),
    [
        ((12.0, 14.0), (6.0, 8.0), 3.0, {"drag_linear": 4.0, "wind": 2.0}),
        ((12.0, 14.0), (6.0, 8.0), None, {"drag_linear": 5.0}),  # one mm came from refitting the base
        ((10.0, 10.0), (11.0, 11.0), 2.0, {"wind": -1.0}),  # it makes the held-out episodes worse
        ((5.0, 5.0), (5.0, 5.0), 9.0, {}),  # better than the reference
    ],
)
def test_the_budget_adds_up_to_the_error_of_the_base(
    twin: Twin, dragged: list[Episode], base: tuple, extended: tuple, floor: float | None, named: dict
) -> None:
    d = answer(twin, dragged)
    errors = with_errors(d, base, extended, floor)
    least = min(floor or 0.0, errors.extended.mean)
    budget = {"named": named, "learned": 0.0, "unexplained": errors.extended.mean - least, "floor": least}
    rows = budget_rows(dataclasses.replace(d, errors=errors, budget=budget))
    assert sum(mm for _, mm, _ in rows) == pytest.approx(np.mean(base), abs=1e-9)
    assert {name: mm for name, mm, _ in rows}["unexplained"] == pytest.approx(budget["unexplained"])


def test_a_cause_of_measurement_is_shown_beside_the_raw_tracks(
    twin: Twin, dragged: list[Episode], tmp_path: Path
) -> None:
    """The extended twin is compared with tracks shifted by 2 cm as its calibration says; both are in the animation.
    """
    d = answer(twin, dragged)
    moved = d.twin.replace(calibration=Calibration(translation=(0.02, 0.0, 0.0)))
    write_report(tmp_path / "report.html", dataclasses.replace(d, twin=moved), dragged, None, "pred diagnose")
    assert "measured, corrected" in (tmp_path / "report.html").read_text("utf-8")


def test_shares_are_of_the_excess_unless_there_is_none(twin: Twin, dragged: list[Episode]) -> None:
    """Losses of 2.0 over a floor of 0.2: shares of 1.8. Over 1.99, or above: shares of 2.0, not of nothing."""
    seen = answer(twin, dragged).rounds[0]
    assert whole_of(seen)[0] == pytest.approx(1.8)
    for floor in (1.99, 2.5):
        assert whole_of(dataclasses.replace(seen, floor=floor))[0] == pytest.approx(2.0)


def test_a_report_of_one_episode_is_written(twin: Twin, tmp_path: Path) -> None:
    """Fewer than any interval needs: bins are drawn from what there is, and it says that there is no interval."""
    episodes = recorded(twin, drag(), ("train",))
    d = answer(twin, episodes)
    d = dataclasses.replace(d, next_motion=propose(d, episodes))
    write_report(tmp_path / "report.html", d, episodes, None, "pred diagnose")
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "One episode: no interval." in text and all(f"<h2>{s}" in text for s in SECTIONS if "{" not in s)


@pytest.mark.parametrize("floor", [0.2, 1.99])
def test_the_label_of_the_evidence_fits_the_figure(twin: Twin, dragged: list[Episode], floor: float) -> None:
    """Also where the excess is next to nothing, which takes more words, beside long names."""
    seen = dataclasses.replace(answer(twin, dragged).rounds[0], floor=floor)
    longest = "friction that grows with another power of the speed"
    words = dict.fromkeys((j.trial.id for j, _, _ in seen.judged), longest)
    figure = evidence(seen, words, None, 0)
    figure.draw_without_rendering()
    label, whole = figure.axes[0].xaxis.label.get_window_extent(), figure.bbox
    assert whole.x0 <= label.x0 and label.x1 <= whole.x1 and whole.y0 <= label.y0
    assert ("next to nothing" in figure.axes[0].get_xlabel()) == (floor > 1.9)


def test_a_change_of_structure_is_told_though_no_round_tried_it(
    twin: Twin, dragged: list[Episode], tmp_path: Path
) -> None:
    """It stands first among the causes; the candidate named after it is still found in its round."""
    d = answer(twin, dragged)
    first = dataclasses.replace(d.causes[0], id="bending_by_angle", family="bending", closed=0.6)
    d = dataclasses.replace(d, causes=(first, *d.causes))
    named = chosen_of(d.rounds, d.causes)
    assert [None if j is None else j.trial.id for j in named] == ["drag_linear"]
    write_report(tmp_path / "report.html", d, dragged, None, "pred diagnose")
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "another structure of the model" in text and "it saves 60% of the loss" in text


def written(d: Diagnosis, episodes: list[Episode], path: Path) -> str:
    """The text of a report, as a reader sees it."""
    write_report(path / "report.html", d, episodes, None, "pred diagnose")
    return (path / "report.html").read_text("utf-8").replace("&#x27;", "'")


def test_a_report_claims_no_more_than_was_done(twin: Twin, dragged: list[Episode], tmp_path: Path) -> None:
    """The larger of two p values, since both causes must hold; no interval where only the search ended; what the gate
    saw but left alone; three episodes, which are too few to draw from; what nobody tried; a network nobody measured.
    """
    d = answer(twin, dragged)
    spans = {k: dataclasses.replace(v, low=0.0, high=50.0, interval=False) for k, v in d.causes[0].parameters.items()}
    causes = (dataclasses.replace(d.causes[0], parameters=spans), Cause("wind", "wind", 0.7, {}, False, 0.3, 0.04))
    table = GateCause("table_height", True, True, "they rest", "m", {"height": (0.01,)}, {}, 0.001, 0.01, 10.0)
    delay = GateCause("delay", True, True, "12 episodes", "s", {"delay": (0.02,)}, {}, 0.001, 0.01, 5.0)
    gate = dataclasses.replace(d.gate, causes=(table, delay))
    text = written(dataclasses.replace(d, causes=causes, gate=gate), dragged, tmp_path)
    assert "p 0.04 (the largest: all causes must hold)" in text and "p 0.001, " not in text
    assert "<td>no interval</td>" in text and "0 to 50" not in text
    assert "<td>another table height</td><td class=text>seen; left to the candidates above</td>" in text
    assert "<td>a delay of the tracks</td><td>found</td>" in text
    assert "(3 episodes: too narrow)</td>" in text and "mm (3 episodes: too narrow)." in text
    assert "<td>learned by a network</td><td>not measured</td>" in text
    assert "Told apart here: quadratic air drag" in text and "told apart here: quadratic air drag, wind" not in text
    assert "family-wise over the finalists of a round, not over all that were screened" in text
    assert "episodes it did not see" not in text


def test_an_interval_over_few_episodes_says_so() -> None:
    """Of five episodes the draws' spread is sqrt(4/5) of the standard error, and Student's t is 2.8 for 2.0."""
    assert span_of(1.0, 2.0, 6) == "1.00 to 2.00"
    assert span_of(1.0, 2.0, 5) == "1.00 to 2.00 (5 episodes: too narrow)"
    assert span_of(1.5, 1.5, 1) == "no interval (1 episode)"


def test_a_floor_above_what_is_left_is_not_drawn_as_the_floor(
    twin: Twin, dragged: list[Episode], tmp_path: Path
) -> None:
    """The reference leaves 7.4 mm on its episodes, 5.0 mm are left here: these are no measured noise and chaos."""
    d = answer(twin, dragged)
    budget = {"named": {"drag_linear": 19.4}, "learned": 0.0, "unexplained": 0.0, "floor": 5.0}
    for floor, name in ((7.4, "left, less than the reference leaves"), (5.0, "floor: noise, chaos, known misfit")):
        errors = with_errors(d, (24.4,), (5.0,), floor)
        rows = {n: mm for n, mm, _ in budget_rows(dataclasses.replace(d, errors=errors, budget=budget))}
        assert rows[name] == 5.0
    least = d.errors.extended.mean
    errors = dataclasses.replace(d.errors, floor=least + 1.0)
    budget = {**d.budget, "unexplained": 0.0, "floor": least}
    text = written(dataclasses.replace(d, errors=errors, budget=budget), dragged, tmp_path)
    assert f"The reference leaves {least + 1.0:.2f} mm on its own episodes, more than the {least:.2f} mm left" in text


def test_time_in_the_recordings_is_shown_where_it_shows_something() -> None:
    """Four episodes of ten frames: one after the other no time has the three that a mean needs; all at once, ten do."""
    size, seen = np.ones((4, 10, 1)), np.ones((4, 10, 1), dtype=bool)
    clock = np.broadcast_to(np.arange(10.0)[None, :, None], size.shape)
    apart = clock + 100.0 * np.arange(4)[:, None, None]
    for time, shown in ((clock, True), (apart, False)):
        rows = dataclasses.replace(by_hand(size, clock, seen), features={"along": clock, "session": time})
        (kept,) = with_clock([rows], 0)
        assert set(kept.features) == ({"along", "session"} if shown else {"along"})


@pytest.mark.parametrize("outcome", ["none", "named", "group", "unknown"])
def test_a_report_opens_with_its_sentence_and_has_every_section(
    twin: Twin, dragged: list[Episode], tmp_path: Path, outcome: str
) -> None:
    """Whatever the outcome; with a reference where something is named. One file that loads nothing."""
    d = answer(twin, dragged, outcome)
    d = dataclasses.replace(d, next_motion=propose(d, dragged))
    assert (d.next_motion is not None) == (outcome in ("named", "group"))
    known = recorded(twin, (), ("train",) * 3, seed=90) if outcome == "named" else None
    path = tmp_path / "report.html"
    means = {"base": 12.0, "base + network": 7.0, "extended": 3.0, "extended + network": 2.5}
    network = {"test": {cell: {"mean": m, "low": m - 1.0, "high": m + 1.0} for cell, m in means.items()}}
    write_report(path, d, dragged, known, "pred diagnose <data>", network if outcome == "group" else None)
    text = path.read_text("utf-8")
    assert text.index(d.sentence) < text.index("<h2>")
    before = "Before and after" if outcome in ("named", "group") else "As it is"
    places = [text.index(f"<h2>{s.format(before=before)}") for s in SECTIONS]
    assert places == sorted(places)
    assert "measured, corrected" not in text
    assert "pred diagnose &lt;data&gt;" in text and "src=\"http" not in text
    assert ("reference's episodes" in text.replace("&#x27;", "'")) == (known is not None)
    assert ("<td>2.5 [1.5, 3.5]</td>" in text) == (outcome == "group")
    assert ("nothing is named" in text) == (outcome in ("none", "unknown"))
    if outcome == "group":
        assert "do not tell air drag from quadratic air drag" in text
    if d.next_motion is not None:
        assert d.next_motion["name"] in text


def test_the_episode_that_is_drawn_has_the_error_of_its_caption(
    twin: Twin, dragged: list[Episode], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A rope that grows by a fifth a minute, drawn in an episode 50 s and more after the session began: on a clock that
    starts with the episode it would not have grown.
    """
    drift = twin.replace(extensions=(find_effect("length_drift").extension(rate=(0.2,)),))
    begin, test = int(dragged[0].stamps[0]), [e for e in dragged if e.split == "test"]
    base, extended = (episode_errors(t, test, begin) for t in (twin, drift))
    errors = Errors("test", base, extended, 1.0, gain_of(base, extended, 0))
    d = dataclasses.replace(answer(twin, dragged), errors=errors, twin=drift.replace(base=twin), session=begin)
    drawn = {}

    def stills(tracks, period, line):  # type: ignore[no-untyped-def]
        measured = tracks[0][1]
        drawn.update({n: 1e3 * np.nanmean(np.linalg.norm(p - measured, axis=-1)) for n, p, _ in tracks})
        return of_tracks(tracks, period, line)

    of_tracks = pictures.stills
    monkeypatch.setattr(pictures, "stills", stills)
    write_report(tmp_path / "report.html", d, dragged, None, "now")
    k = int(np.argsort(base.values)[len(test) // 2])
    assert int(test[k].stamps[0]) - begin >= 50e9
    assert drawn["base"] == pytest.approx(base.values[k], rel=1e-3)
    assert drawn["extended"] == pytest.approx(extended.values[k], rel=1e-3)
    said = re.search(r"base ([\d.]+) mm, extended ([\d.]+) mm", (tmp_path / "report.html").read_text())
    assert said and [float(v) for v in said.groups()] == pytest.approx([drawn["base"], drawn["extended"]], abs=0.2)
    assert episode_errors(drift, [test[k]]).mean < 0.5 * extended.values[k], "the clock does nothing here"

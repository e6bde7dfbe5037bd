"""The benchmark of hidden effects: what counts as a false alarm, a right name, a pair; its intervals; its cases."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from bench_modules import loaded_modules
from hidden_answers import MODULES, answer

from pred_core.effects import LIBRARY, find_effect
from pred_core.errors import ConfigError
from pred_core.plant.hidden.library import LIBRARY as HIDDEN


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    yield from loaded_modules(MODULES)


def judge(bench: dict[str, ModuleType], hidden: Sequence[tuple[str, float]], said: dict[str, Any], **more: Any) -> Any:
    name = more.pop("name", "case1")
    return bench["hidden_scores"].judged(
        name, "ref1", tuple(hidden), said, more.get("commissioned", {}), more.get("oracle"), more.get("paired")
    )


def cell(bench: dict[str, ModuleType], rows: Sequence[Any], metric: str, column: str = "all") -> Any:
    table = bench["hidden_table"].scores(rows)["table"]
    return next(r["cells"][column] for r in table if r["metric"] == metric)


def test_no_false_alarm_in_forty_controls_leaves_room_for_nine_percent(bench: dict[str, ModuleType]) -> None:
    interval = bench["hidden_scores"].clopper_pearson
    assert interval(0, 40) == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 40)), abs=1e-12)  # (1 - p)^40 = 2.5 %
    assert round(100 * interval(0, 40)[1], 1) == 8.8
    assert interval(40, 40)[0] == pytest.approx(0.025 ** (1 / 40)) and interval(40, 40)[1] == 1.0
    # With 1 of 2: P(X >= 1) = 1 - (1 - p)^2 = 2.5 % and P(X <= 1) = 1 - p^2 = 2.5 %.
    assert interval(1, 2) == pytest.approx((1 - 0.975**0.5, 0.975**0.5))


def test_a_control_that_gets_a_name_or_is_called_unknown_is_a_false_alarm(bench: dict[str, ModuleType]) -> None:
    rows = [
        judge(bench, (), answer("none"), name="a"),
        judge(bench, (), answer("named", ("wind", {})), name="b"),
        judge(bench, (), answer("unknown"), name="c"),
        judge(bench, (), answer("none"), name="d"),
    ]
    assert cell(bench, rows, "controls: anything but none")["count"] == 2
    assert cell(bench, rows, "controls: something named")["count"] == 1
    assert [r.right for r in rows] == [True, False, False, True]


def test_names_that_are_not_stood_by_do_not_count(bench: dict[str, ModuleType]) -> None:
    """An answer "unknown" may list what closes a part; it names nothing."""
    row = judge(bench, [("drag_linear", 1.0)], answer("unknown", ("drag_linear", {"coefficient": (1.0, 0.9, 1.1)})))
    assert row.named == () and not row.right
    assert cell(bench, [row], "one effect: detected (anything but none)")["count"] == 1
    assert cell(bench, [row], "one effect: right name first")["count"] == 0


def test_a_relative_of_the_truth_has_the_right_family_and_the_wrong_name(bench: dict[str, ModuleType]) -> None:
    row = judge(bench, [("drag_linear", 1.0)], answer("group", ("drag_quadratic", {}), group=["drag_linear"]))
    assert cell(bench, [row], "one effect: right name first")["count"] == 0
    assert cell(bench, [row], "one effect: right family first")["count"] == 1
    assert cell(bench, [row], "one effect: truth in the group, where named")["count"] == 1
    assert cell(bench, [row], "size of the group, mean")["value"] == 2.0


def test_outside_the_library_a_near_law_is_told_from_a_false_name(bench: dict[str, ModuleType]) -> None:
    rows = [
        judge(bench, [("drag_three_halves", 1.0)], answer("named", ("drag_linear", {})), name="near"),
        judge(bench, [("drag_three_halves", 1.0)], answer("named", ("tether", {})), name="far"),
        judge(bench, [("swirl", 1.0)], answer("unknown"), name="unknown"),
        judge(bench, [("gust", 1.0)], answer("named", ("wind", {})), name="no kin"),
    ]
    assert cell(bench, rows, "outside the library: unknown")["count"] == 1
    assert cell(bench, rows, "outside the library: named, family wrong")["count"] == 2
    assert cell(bench, rows, "outside the library: named, family right, law wrong")["count"] == 1
    assert [r.right for r in rows] == [False, False, True, False]


def test_two_effects(bench: dict[str, ModuleType]) -> None:
    hidden = [("heavy_tip", 2.0), ("sticky_patch", 5.0)]
    both = judge(bench, hidden, answer("named", ("friction_patch", {}), ("tip_mass", {})), name="both")
    one = judge(bench, hidden, answer("named", ("tip_mass", {})), name="one")
    one_false = judge(bench, hidden, answer("named", ("tip_mass", {}), ("wind", {})), name="one and a false one")
    nothing = judge(bench, hidden, answer("none"), name="nothing")
    rows = [both, one, one_false, nothing]
    assert cell(bench, rows, "two effects: exactly both")["count"] == 1
    assert cell(bench, rows, "two effects: one or both right, none false")["count"] == 2


def test_parameter_errors_in_the_librarys_units(bench: dict[str, ModuleType]) -> None:
    def error(hidden: tuple[str, float], id: str, **values: tuple[float, float, float]) -> tuple[Any, Any]:
        found = {k.replace("_0", "[0]").replace("_1", "[1]").replace("_2", "[2]"): v for k, v in values.items()}
        row = judge(bench, [hidden], answer("named", (id, found)), commissioned={"time": 0.02})
        return row.parameter_error, row.covered

    assert error(("drag_linear", 1.0), "drag_linear", coefficient=(0.9, 0.7, 0.95)) == (pytest.approx(0.1), False)
    assert error(("action_delay", 40.0), "delay", delay=(0.042, 0.03, 0.05)) == (pytest.approx(0.05), True)
    unmeasured: Any = (0.9, None, None)  # null in diagnosis.json: nobody measured an interval
    assert error(("drag_linear", 1.0), "drag_linear", coefficient=unmeasured) == (pytest.approx(0.1), None)
    # The library's ball holds the rope's 4 mm: a hidden one of 46 mm is one of 50 mm there.
    assert error(("obstacle", 0.046), "obstacle", radius=(0.055, 0.05, 0.06)) == (pytest.approx(0.1), True)
    # (3, 4) m/s is a wind of 5 m/s; the interval of a component says nothing of the length.
    none = (0.0, 0.0, 0.0)
    assert error(("wind", 4.0), "wind", velocity_0=(3.0, 2, 4), velocity_1=(4.0, 3, 5)) == (pytest.approx(0.25), None)
    # g sin and g (1 - cos) of 2 degrees, read as 2 degrees.
    side, up = 9.81 * np.sin(np.radians(2)), 9.81 * (1 - np.cos(np.radians(2)))
    lean = error(("gravity_tilt", 2.0), "gravity_offset", acceleration_0=(0.0, 0, 0), acceleration_1=(side, 0, 0),
                 acceleration_2=(up, 0, 0))  # fmt: skip
    assert lean == (pytest.approx(0.0, abs=1e-9), None)
    # The base damps with 0.02 s; three times as much more is 0.08 s.
    assert error(("internal_damping", 3.0), "bending_damping", time=(0.08, 0.07, 0.09)) == (pytest.approx(0.0), True)
    assert error(("stiff_region", 5.0), "bending_region", change=(5.0, 4.0, 6.0)) == (None, None)
    assert error(("wind", 4.0), "gravity_offset", acceleration_0=none) == (None, None), "another name has no error"


def test_strength_is_measured_by_the_controls_of_the_same_reference(bench: dict[str, ModuleType]) -> None:
    rows = [
        judge(bench, (), answer("none", base=9.0), name="c1"),
        judge(bench, (), answer("none", base=11.0), name="c2"),
        judge(bench, [("wind", 4.0)], answer("none", base=12.0), name="w"),
        judge(bench, [("wind", 9.0)], answer("named", ("wind", {}), base=13.0), name="v"),
    ]
    assert bench["hidden_scores"].strengths(rows) == pytest.approx({"c1": 1.0, "c2": 1.0, "w": 1.2, "v": 1.3})
    metric = "one effect: right name first"
    assert (cell(bench, rows, metric, "1.1 to 1.3")["count"], cell(bench, rows, metric, ">= 1.3")["count"]) == (0, 1)


def test_strength_is_measured_on_the_same_motions_where_that_is_known(bench: dict[str, ModuleType]) -> None:
    rows = [
        judge(bench, (), answer("none", base=20.0), name="c"),
        judge(bench, [("wind", 4.0)], answer("named", ("wind", {}), base=12.0), name="w", paired={"error_mm": 8.0}),
    ]
    assert bench["hidden_scores"].strengths(rows)["w"] == pytest.approx(1.5)
    assert cell(bench, rows, "one effect: right name first", ">= 1.3")["count"] == 1


def test_share_of_the_avoidable_error(bench: dict[str, ModuleType]) -> None:
    oracle = {"error_mm": 6.0, "error_mm_ood": 19.5}
    row = judge(bench, [("wind", 4.0)], answer("named", ("wind", {}), base=10.0, extended=7.0), oracle=oracle)
    assert cell(bench, [row], "avoidable error closed, median")["value"] == pytest.approx(0.75)  # 3 of 4 mm
    strong = judge(bench, [("swirl", 1.0)], answer("unknown", base=10.0, extended=9.0), paired={"error_mm": 5.0})
    assert cell(bench, [strong], "error that the effect adds closed, median")["value"] == pytest.approx(0.2)  # 1 of 5
    # Out of distribution 0.5 of 20 mm is avoidable: less than 5 %, nothing to close a share of.
    assert cell(bench, [row], "avoidable error closed out of distribution, median") is None


def test_calibration_by_hand(bench: dict[str, ModuleType]) -> None:
    scores = bench["hidden_scores"]
    # 0.9 twice with one right: |0.5 - 0.9|; 0.25 twice, none right: 0.25. Two bins of two cases each.
    p, hit = [0.9, 0.9, 0.25, 0.25], [True, False, False, False]
    assert scores.calibration_error(p, hit) == pytest.approx(0.5 * 0.4 + 0.5 * 0.25)
    assert scores.brier(p, hit) == pytest.approx((0.01 + 0.81 + 2 * 0.0625) / 4)
    row = judge(bench, [("swirl", 1.0)], answer("unknown", ranking=[("unknown", 0.7), ("none", 0.1)]))
    assert (row.confidence, row.on_truth, row.right) == (0.7, 0.7, True)


def test_every_hidden_effect_has_its_name_in_the_library(bench: dict[str, ModuleType]) -> None:
    same = bench["hidden_scores"].SAME
    assert set(same) == set(HIDDEN)
    families = {e.family for e in LIBRARY.values()}
    for name, entry in same.items():
        assert bool(entry.id) == (not HIDDEN[name].unlisted), name
        assert not entry.family or entry.family in families, name
        if entry.id:
            assert find_effect(entry.id).family == entry.family, name
        if entry.parameter:
            assert entry.parameter in {q.name for q in find_effect(entry.id).parameters}, name


def test_cases_are_a_function_of_their_seeds(bench: dict[str, ModuleType]) -> None:
    drawn = bench["hidden_cases"].release("final")
    kinds = [tuple(n for n, _ in c.hidden) for c in drawn.cases]
    assert len(kinds) == 102 and kinds.count(()) == 40
    assert sum(len(k) == 2 for k in kinds) == 6
    assert sum(len(k) == 1 and HIDDEN[k[0]].unlisted for k in kinds) == 10
    assert [c.reference for c in drawn.cases[:5]] == ["ref50000", "ref51000", "ref52000", "ref53000", "ref50000"]
    assert drawn.cases == bench["hidden_cases"].release("final").cases
    seeds = {c.seed for c in drawn.cases} | set(drawn.references.values())
    tuned, seen = (bench["hidden_cases"].release(name) for name in ("dev", "seen"))
    assert not seeds & ({c.seed for c in tuned.cases} | set(tuned.references.values()))
    looked_at = {c.seed for c in seen.cases}
    spans = (50101, 50130), (50201, 50307), (50501, 50535), (50701, 50765), (51101, 51179), (51401, 51503)
    spans += (51601, 51703), (51901, 52003), (52101, 52203)
    assert looked_at == {s for span in spans for s in range(*span)}
    assert seeds & looked_at == {52000}, "a control of the last draw, diagnosed with another reference than this one"
    sized = bench["hidden_cases"].release("extents")
    assert not {c.seed for c in sized.cases} & (seeds | looked_at) and {c.extent for c in sized.cases} == {0.6, 1.6}
    magnitudes = [{m for c in r.cases for n, m in c.hidden if m < HIDDEN[n].high} for r in (drawn, seen, tuned)]
    assert len(magnitudes[0]) > 50 and not magnitudes[0] & (magnitudes[1] | magnitudes[2])  # drawn anew, too
    for case in drawn.cases:
        for name, magnitude in case.hidden:
            entry = HIDDEN[name]
            assert min(2 * entry.minimum, entry.high) <= magnitude <= min(10 * entry.minimum, entry.high)


def test_how_alike_values_of_a_group_are(bench: dict[str, ModuleType]) -> None:
    """Alike and different from the other group: 1. Groups of the same mean: B = 0, -W / W = -1. Three and one of
    (0, 2, 4), 2: W = 8 / 2 = 4, B = 0, n = (4 - 10 / 4) / 1 = 1.5, so -4 / (0.5 * 4) = -2.
    """
    correlation = bench["hidden_flips"].correlation
    two = np.array([0, 0, 1, 1])
    assert correlation(np.array([1.0, 1.0, 3.0, 3.0]), two) == pytest.approx(1.0)
    assert correlation(np.array([1.0, 3.0, 1.0, 3.0]), two) == pytest.approx(-1.0)
    assert correlation(np.array([0.0, 2.0, 4.0, 2.0]), np.array([7, 7, 7, 9])) == pytest.approx(-2.0)
    with pytest.raises(ConfigError, match="journals of controls; got 0 of 0 with gains"):
        bench["hidden_flips"].flips([])


def test_fake_laws_are_six_null_at_null_and_only_in_their_own_process(bench: dict[str, ModuleType]) -> None:
    placebos = bench["hidden_placebos"].PLACEBOS
    assert len(placebos) == 6 and not {e.id for e in placebos} & set(LIBRARY)
    from pred_core.effects.algebra import Vec3
    from pred_core.effects.effect import ContactContext, ParticleContext

    one, vector = torch.tensor(0.7), Vec3(*torch.tensor([0.3, -0.2, 0.11]))
    for effect in placebos:
        for on in (False, True):
            p = {q.name: (torch.tensor(0.5 if on else q.null),) for q in effect.parameters}
            if "force" in effect.hooks:
                added = effect.force(p, ParticleContext(vector, vector, one, one, one)).tensor()
            elif "contact" in effect.hooks:
                added = effect.contact(p, ContactContext(vector, vector, one, one))[0]
            elif "inertia" in effect.hooks:
                added = effect.inertia(p, one)
            else:
                added = effect.bend_stiffness(p, one, one)
            assert bool(added.any()) == on, effect.id


def test_the_regression_names_a_change_and_only_a_change(bench: dict[str, ModuleType]) -> None:
    """Normal equations of a known change: drag of 1 /s in six episodes of 40 rows, none in six others."""
    sindy = bench["hidden_sindy"]
    rng = np.random.default_rng(0)
    drag = sindy.CAUSES.index("drag_linear")

    def episode(coefficient: float) -> Any:
        theta = rng.normal(size=(len(sindy.CAUSES), 400))
        y = 2.0 * theta[0] + coefficient * theta[drag] + rng.normal(0.0, 0.1, 400)
        return sindy.Normal(theta @ theta.T, theta @ y)

    plain, dragged = [episode(0.0) for _ in range(6)], [episode(1.0) for _ in range(6)]
    assert sindy.name(dragged, plain)[0] == "drag_linear"
    assert sindy.name([episode(0.0) for _ in range(6)], plain) == ("none", 1.0)


def test_tension_of_any_size_leaves_no_trace_in_the_regression(bench: dict[str, ModuleType]) -> None:
    """Particles of a bent line pulled by their edges alone: nothing is left. Weight on a level line: all of it is."""
    rng = np.random.default_rng(1)
    line = np.linspace(0.0, 1.0, 12)[:, None] * np.array([1.0, 0.0, 0.0])
    x = line + rng.normal(0.0, 0.02, (5, 12, 3))
    edge = np.diff(x, axis=1)
    pull = rng.normal(0.0, 300.0, (5, 11, 1)) * edge / np.linalg.norm(edge, axis=-1, keepdims=True)
    without = bench["hidden_sindy"]._without_tension
    tension = np.diff(pull, axis=1)[:, 1:-1].reshape(1, 5, -1)
    assert np.abs(without(x, tension)).max() < 1e-9
    weight = np.tile([0.0, 0.0, -9.81], (1, 5, 8))
    level = np.broadcast_to(line, (5, 12, 3))
    assert np.allclose(without(level, weight), weight)

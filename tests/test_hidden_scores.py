"""The benchmark of hidden effects: what counts as a false alarm, a right name, a pair; its intervals; its cases."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from bench_modules import loaded_modules

from pred_core.effects import LIBRARY, find_effect
from pred_core.plant.hidden.library import LIBRARY as HIDDEN

FOLDER = Path(__file__).parents[1] / "benchmarks"
MODULES = ("hidden_cases", "hidden_scores", "hidden_table", "hidden_bench", "hidden_sindy", "hidden_placebos",
           "hidden_effects")  # fmt: skip


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    yield from loaded_modules(MODULES)


def answer(
    outcome: str,
    *causes: tuple[str, dict[str, tuple[float, float, float]]],
    group: Sequence[str] = (),
    base: float = 10.0,
    extended: float = 8.0,
    ranking: Sequence[tuple[str, float]] = (),
) -> dict[str, Any]:
    """A made-up diagnosis.json; parameters as (value, low, high)."""
    return {
        "outcome": outcome,
        "causes": [
            {
                "id": id, "family": find_effect(id).family, "probability": 0.9, "kind": "physics", "group": list(group),
                "parameters": {k: dict(zip(("value", "low", "high"), v, strict=True)) for k, v in values.items()},
            }
            for id, values in causes
        ],
        "ranking": [{"id": i, "probability": p} for i, p in ranking],
        "error_mm": {"base": base, "extended": extended, "floor": 7.0},
        "error_mm_ood": {"base": 2 * base, "extended": 2 * extended},
        "seconds": 100.0,
    }  # fmt: skip


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
    assert looked_at == {*range(50101, 50130), *range(50201, 50307), *range(50501, 50535)} and not seeds & looked_at
    magnitudes = [{m for c in r.cases for n, m in c.hidden if m < HIDDEN[n].high} for r in (drawn, seen, tuned)]
    assert len(magnitudes[0]) > 50 and not magnitudes[0] & (magnitudes[1] | magnitudes[2])  # drawn anew, too
    for case in drawn.cases:
        for name, magnitude in case.hidden:
            entry = HIDDEN[name]
            assert min(2 * entry.minimum, entry.high) <= magnitude <= min(10 * entry.minimum, entry.high)


def test_runs_go_on_and_say_what_failed(
    bench: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two cases, one already diagnosed, the other fails: nothing is done twice and the exit code says so."""
    effects = bench["hidden_effects"]
    drawn = bench["hidden_cases"].release("final")
    calls = tmp_path / "calls"

    def pred(words: Sequence[str], log: Path, program: Sequence[str] = ()) -> int:
        with calls.open("a") as stream:
            stream.write(f"{words[0]} {Path(words[1]).name}\n")
        if words[0] == "identify":
            twin = Path(words[words.index("--out") + 1])
            twin.mkdir(parents=True)
            (twin / "twin.yaml").touch()
        return 0 if words[0] == "identify" else 2

    monkeypatch.setattr(effects, "_pred", pred)
    monkeypatch.setattr(effects, "simulate", lambda root, hidden, seed: None)
    done = tmp_path / "out" / "case50701"
    done.mkdir(parents=True)
    (done / "diagnosis.json").write_text("{}")
    words = ["x", "run", "--work", str(tmp_path), "--jobs", "1", "--only", "case50701", "case50702"]
    monkeypatch.setattr(sys, "argv", words)
    assert effects.main() == 1
    assert effects.main() == 1
    said = capsys.readouterr().out
    assert "case50702 failed with code 2" in said and "1 of 2 cases are there" in said
    twins = [f"identify {c.reference}" for c in drawn.cases[:2]]
    assert calls.read_text().splitlines() == [*twins, *["diagnose case50702"] * 2]


def test_scores_are_written_and_foreign_truths_refused(
    bench: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = next(c for c in bench["hidden_cases"].release("final").cases if not c.hidden)
    out = tmp_path / "out" / case.name
    out.mkdir(parents=True)
    (out / "diagnosis.json").write_text(json.dumps(answer("none", ranking=[("none", 0.9)])))
    truth = tmp_path / f"{case.name}.truth.json"
    truth.write_text(json.dumps({"hidden": [], "seed": case.seed}))
    monkeypatch.setattr(sys, "argv", ["x", "score", "--work", str(tmp_path), "--only", case.name])
    assert bench["hidden_effects"].main() == 0
    assert "0/1 = 0 % [0.0 to 97.5]" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / "scores.json").read_text())["confusion"] == {"none": {"none": 1}}
    truth.write_text(json.dumps({"hidden": [], "seed": case.seed + 1}))
    with pytest.raises(SystemExit, match="of another case"):
        bench["hidden_effects"].main()


def test_each_step_is_left_out_in_turn_and_compared_on_the_same_cases(
    bench: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two controls. With all steps both are none; without cross-fitting the one that it answered is a false alarm."""
    effects = bench["hidden_effects"]
    controls = [c for c in bench["hidden_cases"].release("final").cases if not c.hidden][:2]
    calls = []

    def pred(words: Sequence[str], log: Path, program: Sequence[str] = ()) -> int:
        calls.append(words)
        return 0

    monkeypatch.setattr(effects, "_pred", pred)
    monkeypatch.setattr(effects, "_all", lambda what, names, jobs, do: [n for n in names if do(n)])
    monkeypatch.setattr(effects, "simulate", lambda root, hidden, seed: None)
    one = controls[0].name
    monkeypatch.setattr(sys, "argv", ["x", "ablate", "--work", str(tmp_path), "--only", one])
    assert effects.main() == 0
    diagnosed = [words for words in calls if words[0] == "diagnose"]
    steps = ("settle", "back_fit", "cross_fit", "chaos_weights")
    assert [Path(w[w.index("--out") + 1]).parent.name for w in diagnosed] == [f"out_no_{s}" for s in steps]
    assert [w[-1] for w in diagnosed] == ["--no-settle", "--no-back-fit", "--no-cross-fit", "--no-chaos-weights"]
    named = answer("named", ("drag_linear", {"coefficient": (1.0, 0.5, 1.5)}), ranking=[("drag_linear", 0.9)])
    none = answer("none", ranking=[("none", 0.9)])
    for case in controls:
        (tmp_path / f"{case.name}.truth.json").write_text(json.dumps({"hidden": [], "seed": case.seed}))
    for out, name, said in (("out", one, none), ("out", controls[1].name, none), ("out_no_cross_fit", one, named)):
        (tmp_path / out / name).mkdir(parents=True, exist_ok=True)
        (tmp_path / out / name / "diagnosis.json").write_text(json.dumps(said))
    monkeypatch.setattr(sys, "argv", ["x", "score", "--work", str(tmp_path), "--only", *(c.name for c in controls)])
    assert effects.main() == 0
    shown = capsys.readouterr().out.splitlines()
    row = next(n for n, line in enumerate(shown) if line.startswith("|") and "without cross_fit" in line)
    assert "without settle" not in shown[row]
    assert "0/1 = 0 %" in shown[row + 2] and "1/1 = 100 %" in shown[row + 2]  # controls: anything but none


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

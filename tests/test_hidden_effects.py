"""Something is hidden in MuJoCo's world: `pred diagnose` must find it, name nothing where nothing is, and say unknown.

Fixed cases have development seeds; one case is drawn at run time, and printed. All cases go through the command line.
"""

from __future__ import annotations

import json
import os
import secrets
import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pred_core.effects import LIBRARY
from pred_core.plant.hidden.library import LIBRARY as HIDDEN
from pred_core.plant.rope_case import write_rope_case
from pred_core.plant.session import SessionConfig

SESSION = SessionConfig(train=12, test=4, ood=0, seconds=4.0)
REFERENCE = 7000
LIMIT = 900  # [s] for a command
SECONDS = {1: 300, 2: 800}  # [s] for a diagnosis of so many causes: a busy machine may need more to look for a second
PRED = (sys.executable, "-m", "pred_core.cli.main")
Hidden = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Case:
    """What is hidden, and the causes one of which a right answer begins with; none: nothing may be named."""

    name: str
    seed: int
    hidden: Hidden
    right: tuple[str, ...]


SINGLES = (
    Case("drag", 7202, (("drag_linear", 1.8),), ("drag_linear",)),
    Case("friction", 7206, (("friction_scale", 1.2),), ("friction_scale",)),
    Case("table", 7210, (("table_height", 0.018),), ("table_height",)),
    Case("mass", 7241, (("mass_gradient", 1.9),), ("mass_gradient",)),
    Case("gravity", 7203, (("gravity_tilt", 5.0),), ("gravity_offset",)),
    Case("slip", 7240, (("gripper_slip", 13.0),), ("grip_slip",)),
    Case("stiffness_drift", 7120, (("stiffness_drift", 2.6),), ("stiffness_drift",)),
    Case("delay", 7222, (("action_delay", 40.0),), ("delay",)),
    Case("offset", 7122, (("gripper_offset", 0.013),), ("gripper_offset",)),
)
CONTROLS = tuple(Case(f"control{s}", s, (), ()) for s in (7116, 7118, 7124))
UNKNOWN = Case("gust", 7114, (("gust", 0.4),), ())
PAIR = Case("pair", 7230, (("drag_linear", 2.0), ("table_height", 0.02)), ("drag_linear", "table_height"))
# Hidden effects whose family a strong case must show, and the families of ours that are right.
DRAWN = {
    "drag_linear": ("drag",), "drag_quadratic": ("drag",), "gravity_tilt": ("gravity",), "table_height": ("table",),
    "bending_stiffness": ("bending",), "friction_scale": ("friction",), "action_delay": ("delay",),
    "camera_scale": ("camera",), "gripper_offset": ("gripper_offset",),
}  # fmt: skip


def drawn() -> Case:
    """A strong case of this run: the seed comes from the system, or from PRED_HIDDEN_SEED to repeat one."""
    seed = int(os.environ.get("PRED_HIDDEN_SEED") or secrets.randbelow(1_000_000))
    rng = np.random.default_rng(seed)
    name = str(rng.choice(sorted(DRAWN)))
    magnitude = min(HIDDEN[name].minimum * float(rng.uniform(6.0, 10.0)), HIDDEN[name].high)
    print(f"drawn: {name} {magnitude:.4g} {HIDDEN[name].unit}, seed {seed}; PRED_HIDDEN_SEED={seed} repeats it")
    return Case("drawn", 100_000 + seed, ((name, magnitude),), ())


class Answers:
    """Runs all cases on two processes; an answer is waited for when a test asks for it."""

    def __init__(self, root: Path):
        self.root = root
        self.drawn = drawn()
        self.pool = ThreadPoolExecutor(2)
        self.reference = self.pool.submit(self._reference)
        cases = (*SINGLES, *CONTROLS, UNKNOWN, PAIR, self.drawn)
        self.futures: dict[str, Future[dict]] = {c.name: self.pool.submit(self._diagnose, c) for c in cases}  # type: ignore[type-arg]

    def __getitem__(self, case: Case) -> dict:  # type: ignore[type-arg]
        return self.futures[case.name].result()

    def _reference(self) -> tuple[Path, Path]:
        data, twin = self.root / "reference", self.root / "twin"
        self._simulate(data, (), REFERENCE)
        self._pred("identify", data, "--out", twin, "--parameters",
                   "stiffness,damping,ground_friction,bending_stiffness", "--effects", "bending_damping",
                   "--restarts", "2")  # fmt: skip
        return data, twin

    def _diagnose(self, case: Case) -> dict:  # type: ignore[type-arg]
        data, out = self.root / case.name, self.root / f"{case.name}.out"
        self._simulate(data, case.hidden, case.seed)
        reference, twin = self.reference.result()
        limit = SECONDS[max(len(case.hidden), 1)]
        self._pred("diagnose", data, "--twin", twin, "--reference", reference, "--out", out, "--seconds", limit)
        answer = json.loads((out / "diagnosis.json").read_text())
        print(case.name, case.hidden, answer["sentence"])
        return dict(answer)

    def _simulate(self, root: Path, hidden: Hidden, seed: int) -> None:
        # In a process of its own: a hidden world and what judges it share nothing but the bags.
        code = f"from pathlib import Path; from {__name__} import write; write(Path({str(root)!r}), {hidden!r}, {seed})"
        self._run((sys.executable, "-c", code), Path(__file__).parent)

    def _pred(self, *words: object) -> None:
        self._run((*PRED, *map(str, words)), None)

    def _run(self, words: tuple[str, ...], where: Path | None) -> None:
        path = os.pathsep.join(p for p in (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")) if p)
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
        done = subprocess.run(words, cwd=where, env=environment, timeout=LIMIT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]


def write(root: Path, hidden: Hidden, seed: int) -> None:
    """One data set of the hidden world."""
    write_rope_case(root, hidden, seed, lambda *_: None, session=SESSION)


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Answers:
    return Answers(tmp_path_factory.mktemp("hidden"))


def said(answer: dict) -> str:  # type: ignore[type-arg]
    """For the message of a failed test."""
    return f"{answer['outcome']}: {answer['sentence']}"


@pytest.mark.parametrize("case", SINGLES, ids=lambda c: c.name)
def test_a_hidden_effect_is_named(case: Case, answers: Answers) -> None:
    answer = answers[case]
    assert answer["outcome"] in ("named", "group"), said(answer)
    assert answer["causes"][0]["id"] in case.right, said(answer)


def test_the_size_of_what_is_hidden_is_found(answers: Answers) -> None:
    """Within 15 %: what the median of many cases is well below (benchmarks/hidden_effects.py)."""
    drag = answers[SINGLES[0]]["causes"][0]["parameters"]["coefficient"]["value"]
    table = answers[SINGLES[2]]["causes"][0]["parameters"]["height"]["value"]
    delay = answers[SINGLES[7]]["causes"][0]["parameters"]["delay"]["value"]
    assert drag == pytest.approx(1.8, rel=0.15)
    assert table == pytest.approx(0.018, rel=0.15)
    assert delay == pytest.approx(0.040, rel=0.15)


def test_the_extended_twin_predicts_better_than_the_base(answers: Answers) -> None:
    for case in SINGLES[:3]:
        error = answers[case]["error_mm"]
        assert error["extended"] < 0.8 * error["base"], said(answers[case])


@pytest.mark.parametrize("case", CONTROLS, ids=lambda c: c.name)
def test_nothing_is_named_where_nothing_is_hidden(case: Case, answers: Answers) -> None:
    answer = answers[case]
    assert answer["outcome"] == "none" and not answer["causes"], said(answer)


def test_what_no_candidate_explains_is_called_unknown(answers: Answers) -> None:
    assert answers[UNKNOWN]["outcome"] == "unknown", said(answers[UNKNOWN])


def test_two_hidden_effects_are_both_named(answers: Answers) -> None:
    answer = answers[PAIR]
    assert {c["id"] for c in answer["causes"]} == set(PAIR.right), said(answer)


def test_the_family_of_a_case_drawn_in_this_run_is_right(answers: Answers) -> None:
    answer = answers[answers.drawn]
    hidden = answers.drawn.hidden[0][0]
    assert answer["causes"], f"{answers.drawn.hidden}, seed {answers.drawn.seed}: {said(answer)}"
    family = answer["causes"][0]["family"]
    assert family in DRAWN[hidden], f"{answers.drawn.hidden}, seed {answers.drawn.seed}: {said(answer)}"


def test_every_family_that_counts_as_right_exists() -> None:
    ours = {e.family for e in LIBRARY.values()}
    assert {f for families in DRAWN.values() for f in families} <= ours

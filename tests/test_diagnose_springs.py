"""`pred diagnose` on springs of other code: nothing where nothing is hidden, and drag where it is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from diagnose_runs import PARTICLES, SPRINGS, diagnose, matched, read
from plant_cases import hurry

from pred_core.plant.session import SessionConfig
from pred_core.plant.springs import Line, write_springs_case
from pred_core.twin import Twin
from pred_core.types import Array

PLANTED = 3.0  # [1/s]


@pytest.fixture(scope="module")
def springs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """`twin`; data sets `reference`, `control` and `drag` of seven episodes of 2 s, each of other motions."""
    root = tmp_path_factory.mktemp("springs")
    matched().save(root / "twin")
    session = SessionConfig(train=5, test=2, ood=0, seconds=2.0, particles=PARTICLES)
    step = Line.step
    with pytest.MonkeyPatch.context() as patch:
        hurry(patch)
        for seed, name in ((40, "reference"), (41, "control"), (43, "drag")):

            def dragging(self: Line, x: Array, v: Array, held: Array, drag: float, h: float) -> tuple[Array, Array]:
                return step(self, x, v, held, drag or PLANTED, h)

            patch.setattr(Line, "step", dragging if name == "drag" else step)
            write_springs_case(root / name, seed, lambda *_: None, session=session, springs=SPRINGS)
    yield root


def test_nothing_is_named_where_nothing_is_hidden(springs: Path, tmp_path: Path) -> None:
    assert diagnose(springs / "control", springs / "twin", tmp_path, "--reference", str(springs / "reference")) == 0
    d = read(tmp_path)
    assert d["outcome"] == "none" and d["causes"] == [] and d["exploratory"] is True
    assert "Nothing is found" in d["sentence"] and not Twin.load(tmp_path / "twin").extensions


def test_drag_is_named_in_a_world_of_other_code(springs: Path, tmp_path: Path) -> None:
    """Float64, finer steps, noise, drop-outs and jitter of a tracker; exploratory: 10 % from seven short episodes."""
    assert diagnose(springs / "drag", springs / "twin", tmp_path, "--reference", str(springs / "reference")) == 0
    d = read(tmp_path)
    assert d["outcome"] in ("named", "group") and d["exploratory"] is True
    assert d["causes"][0]["id"] == "drag_linear"
    assert d["causes"][0]["parameters"]["coefficient"]["value"] == pytest.approx(PLANTED, rel=0.1)

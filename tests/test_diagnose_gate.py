"""The model-free gate finds what is planted, with its size, and nothing where nothing is planted."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from gate_cases import LEVERS, bare_twin, moving_episodes

from pred_core.bag.deform import deform_episode, read_deform
from pred_core.bag.measured import find_measured
from pred_core.calibration import Calibration
from pred_core.diagnose.gate import measure
from pred_core.errors import DatasetError
from pred_core.frames import quaternion_rotate
from pred_core.plant.rope_case import write_rope_case
from pred_core.plant.session import SessionConfig
from pred_core.types import Episode, Grip

CAMERA, TURN = (0.7, -0.6, 0.8), (0.02, -0.02, 0.01)
PLANTED = {
    "delay": (Calibration(delay=0.04), {"delay": [0.04]}, 1e-3),  # noise 0.7 mm, 0.3 m/s, 1000 frames: 0.1 ms
    "camera_scale": (Calibration(scale=1.03, center=CAMERA), {"scale": [0.03]}, 1e-3),
    "camera_rotation": (Calibration(rotation=TURN, center=CAMERA), {"rotation": list(TURN)}, 2e-3),
    "camera_translation": (Calibration(translation=(0.004, 0.0, -0.006)), {"translation": [0.004, 0.0, -0.006]}, 1e-3),
    "gripper_offset": (Calibration(gripper_offset=(0.0, 0.012, -0.009)), {"offset": [0.0, 0.012, -0.009]}, 1e-3),
}  # fmt: skip
KNOWN = tuple((id, tuple(map(float, lever))) for id, lever in enumerate(LEVERS))


@pytest.fixture(scope="module")
def reference() -> list[Episode]:
    return moving_episodes(100)


@pytest.mark.parametrize("id", PLANTED)
@pytest.mark.parametrize("told", ["reference", "levers"])
def test_one_planted_error_is_named_and_measured(id: str, told: str, reference: list[Episode]) -> None:
    wrong, expected, tolerance = PLANTED[id]
    against = reference if told == "reference" else None
    twin = bare_twin() if told == "reference" else bare_twin(KNOWN)
    result = measure(moving_episodes(3, wrong), against, twin)
    assert [c.id for c in result.accepted] == [id] and result.accepted[0].confused_with == ()
    for name, values in expected.items():
        assert result.accepted[0].parameters[name] == pytest.approx(values, abs=tolerance)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3)) + (0.0, 0.0, 0.5)
    if id.startswith("camera"):  # whatever its centre, it is the planted map: within 1 mm where the data were
        assert np.abs(result.calibration.report(points) - wrong.report(points)).max() < 1.5e-3
    again = measure(moving_episodes(4, wrong), against, twin.replace(calibration=result.calibration), Calibration())
    assert not again.accepted  # what was found is corrected


def test_a_small_interval_covers_what_is_planted() -> None:
    # 90 % intervals of the delay, 12 draws: fewer than 8 hits has a probability of 0.4 % if they are right.
    hits = 0
    for seed in range(12):
        result = measure(moving_episodes(seed, Calibration(delay=0.01), count=6, frames=50), None, bare_twin(KNOWN))
        low, high = result.cause("delay").interval["delay"][0]
        hits += low <= 0.01 <= high
        assert high - low < 0.002
    assert hits >= 8


def test_nothing_is_found_where_nothing_is_planted(reference: list[Episode]) -> None:
    # 10 controls against a reference and 10 against the twin at 5 % family-wise: 4 or more by chance has 1.6 %.
    alarms = 0
    for seed in range(10):
        episodes = moving_episodes(seed)
        alarms += bool(measure(episodes, reference, bare_twin()).accepted)
        alarms += bool(measure(episodes, None, bare_twin(KNOWN)).accepted)
    assert alarms <= 3


def test_two_errors_at_once(reference: list[Episode]) -> None:
    wrong = Calibration(delay=0.03, scale=0.98, center=CAMERA, gripper_offset=(0.008, 0.0, 0.0))
    result = measure(moving_episodes(7, wrong), reference, bare_twin())
    assert {c.id for c in result.accepted} == {"delay", "camera_scale", "gripper_offset"}
    assert result.calibration.delay == pytest.approx(0.03, abs=1e-3)
    assert result.calibration.scale == pytest.approx(0.98, abs=1e-3)
    assert result.calibration.gripper_offset == pytest.approx((0.008, 0.0, 0.0), abs=1e-3)


def test_a_slide_is_no_calibration(reference: list[Episode]) -> None:
    # 20 mm/s over 3.3 s: 66 mm out of the jaws, along their -z.
    result = measure(moving_episodes(8, slide=0.02), reference, bare_twin())
    assert [c.id for c in result.accepted] == ["grip_slip"] and result.calibration.identity
    assert result.cause("grip_slip").parameters["path"][0] == pytest.approx(-0.066, abs=0.004)
    assert "z axis" in result.cause("grip_slip").why
    path = next(iter(result.slides.values()))
    assert path[1] == pytest.approx(-0.02, abs=0.002)  # after 1 s


def test_what_the_motion_does_not_excite_is_not_testable() -> None:
    still = measure(moving_episodes(1, moves=0.0, turns=0.0), None, bare_twin(KNOWN))
    for id in ("delay", "camera_scale"):
        assert not still.cause(id).testable and not still.cause(id).accepted
    unknown = measure(moving_episodes(1), None, bare_twin())
    assert not unknown.cause("gripper_offset").testable and "reference" in unknown.cause("gripper_offset").why


def test_an_offset_without_turns_may_be_the_camera() -> None:
    straight = moving_episodes(2, Calibration(gripper_offset=(0.01, 0.0, 0.0)), turns=0.0)
    result = measure(straight, moving_episodes(5, turns=0.0), bare_twin())
    (found,) = result.accepted
    assert {found.id, *found.confused_with} >= {"gripper_offset", "camera_translation"}


def test_clocks_that_stumble_are_told() -> None:
    episodes = moving_episodes(1, count=3)
    stamps = episodes[1].stamps.copy()
    stamps[50:] += 12_000_000  # 12 ms of 33: 0.36 periods
    bad = dataclasses.replace(episodes[1], stamps=stamps, tracks=dataclasses.replace(episodes[1].tracks, stamp=stamps))
    notes = measure([episodes[0], bad, episodes[2]], None, bare_twin()).notes
    assert any("uneven stamps" in n and "ep1" in n for n in notes)
    assert not any("clock" in n for n in measure(episodes, None, bare_twin()).notes)


def test_few_episodes_widen_the_gates_own_intervals() -> None:
    """That is all they say: whether the diagnosis is exploratory is decided on the train and test episodes."""
    for count, said in ((3, "3 train episodes, fewer than the 10"), (1, "1 train episode, fewer than the 10")):
        (note,) = (n for n in measure(moving_episodes(1, count=count), None, bare_twin()).notes if "fewer" in n)
        assert "the gate's own intervals" in note and said in note and "exploratory" not in note
    assert not any("fewer" in n for n in measure(moving_episodes(1, count=10), None, bare_twin()).notes)


def test_nothing_to_judge() -> None:
    with pytest.raises(DatasetError, match="no episodes"):
        measure([], None, bare_twin())
    free = [dataclasses.replace(e, held=np.full(2, -1, np.int32)) for e in moving_episodes(1, count=3)]
    result = measure(free, None, bare_twin())
    assert not any(c.testable for c in result.causes) and result.calibration.identity


def test_the_result_is_json() -> None:
    result = measure(moving_episodes(3, Calibration(delay=0.04)), None, bare_twin(KNOWN))
    plain = json.loads(json.dumps(result.to_json()))
    assert plain["causes"][0]["id"] == "delay" and plain["calibration"]["delay"] == result.calibration.delay
    assert plain["sigma_mm"] == pytest.approx(0.7, abs=0.1)  # planted; 2 % from 800 frames, bias of a few


@pytest.fixture(scope="module")
def ropes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Episode]]:
    """MuJoCo ropes of three seeds: nothing hidden; the rope slips over a table that is higher; ridges in the table."""
    root, session = tmp_path_factory.mktemp("ropes"), SessionConfig(train=10, test=0, ood=0, seconds=3.0)
    cases = {
        "plain": (),
        "both": (("gripper_slip", 2.5), ("table_height", 0.012)),
        "ridges": (("table_wave", 0.02),),
    }
    return {
        name: list(write_rope_case(root / name, hidden, 40 + k, lambda *_: None, session=session).episodes("train"))
        for k, (name, hidden) in enumerate(cases.items())
    }


def test_what_another_engine_hides(ropes: dict[str, list[Episode]]) -> None:
    result = measure(ropes["both"], ropes["plain"], bare_twin())
    assert {c.id for c in result.accepted} == {"grip_slip", "table_height"}
    assert "z axis" in result.cause("grip_slip").why
    assert result.cause("table_height").parameters["height"][0] == pytest.approx(0.012, abs=5e-4)
    assert result.calibration.identity  # both are physics


def test_a_table_that_is_not_flat_is_seen(ropes: dict[str, list[Episode]]) -> None:
    relief = measure(ropes["ridges"], ropes["plain"], bare_twin()).cause("table_relief")
    assert relief.accepted and relief.parameters["relief"][0] > 5e-4
    flat = measure(ropes["both"], ropes["plain"], bare_twin()).cause("table_relief")
    assert flat.testable and not flat.accepted
    alone = measure(ropes["ridges"], None, bare_twin()).cause("table_relief")
    assert not alone.testable and "reference" in alone.why


@pytest.mark.parametrize("cable", ["deform_dlo1", "deform_dlo2"])
def test_planted_on_a_measured_cable(cable: str) -> None:
    found = find_measured(cable)
    if found is None:
        pytest.skip(f"measured cable {cable} is not here")
    source = read_deform(Path(found))
    chosen = range(0, len(source.position), 4)
    episodes = [deform_episode(source, i) for i in chosen]
    episodes = [e for e in episodes if e.split == "train"]
    reference, suspect = episodes[::2], episodes[1::2]
    assert not measure(suspect, reference, bare_twin()).accepted

    def moved(e: Episode, position: np.ndarray) -> Episode:
        return dataclasses.replace(e, tracks=dataclasses.replace(e.tracks, position=position))

    late = [moved(e, np.concatenate((np.repeat(e.position[:1], 4, 0), e.position[:-4]))) for e in suspect]
    result = measure(late, reference, bare_twin())
    assert [c.id for c in result.accepted] == ["delay"]
    assert result.calibration.delay == pytest.approx(0.04, abs=1e-3)

    result = measure([moved(e, 1.03 * e.position) for e in suspect], reference, bare_twin())
    assert [c.id for c in result.accepted] == ["camera_scale"]
    assert result.calibration.scale == pytest.approx(1.03, abs=1e-4)

    offset = torch.tensor([0.009, -0.0105, 0.0058])  # 15 mm
    reported = [Grip(g.position - quaternion_rotate(g.rotation, offset), g.rotation, g.closed)
                for g in (e.grips for e in suspect)]  # fmt: skip
    off = [dataclasses.replace(e, grips=g) for e, g in zip(suspect, reported, strict=True)]
    result = measure(off, reference, bare_twin())
    assert [c.id for c in result.accepted] == ["gripper_offset"]
    assert result.calibration.gripper_offset == pytest.approx(tuple(offset.tolist()), abs=1e-4)

"""What sensors and the gripper's pose get wrong, corrected where data enter."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from springmass_cases import line

from pred_core.bag.grippers import PoseFrame
from pred_core.calibration import Calibration, poses_at
from pred_core.effects import LIBRARY
from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import ObserveContext
from pred_core.errors import ConfigError, DatasetError, TwinError
from pred_core.evaluate.models import NamedTwin, shared_calibration
from pred_core.frames import (
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_rotate,
    quaternion_slerp,
    quaternion_to_rotation_vector,
)
from pred_core.identify.levers import mean_levers
from pred_core.live.delay import DelayedPoses
from pred_core.train.recordings import align
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Episode, Grip, ObjectInfo, Physics, Tracks

PERIOD = 20_000_000  # [ns]
WRONG = Calibration(
    delay=0.05, scale=1.03, rotation=(0.02, -0.05, 0.1), center=(0.9, 0.0, 0.8), translation=(0.01, 0.02, -0.03),
    gripper_offset=(0.0, 0.01, -0.02), gripper_rotation=(0.0, 0.2, 0.0),
)  # fmt: skip


def episode(frames: int = 60, missing: int | None = None) -> Episode:
    """Four particles and a gripper that moves along x at 0.5 m/s and turns about z at 1 rad/s; two are held."""
    time = np.arange(frames) * PERIOD * 1e-9
    stamps = 1_000_000_000 + np.arange(frames, dtype=np.int64) * PERIOD
    angle = torch.as_tensor(time)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    place = np.stack((0.5 * time, 0 * time, 0.4 + 0 * time), axis=1)
    levers = np.array([[0.0, 0, 0], [0.02, 0, -0.01]])
    c, s = np.cos(time)[:, None], np.sin(time)[:, None]
    x, y, z = levers.T
    turned = np.stack((c * x - s * y, s * x + c * y, z + 0 * c), axis=-1)
    free = np.array([[0.2, 0.1, 0.0], [0.3, 0.1, 0.0]])
    position = np.concatenate((place[:, None] + turned, np.broadcast_to(free, (frames, 2, 3))), axis=1)
    if missing is not None:
        position[missing, 3] = np.nan
    seen = np.isfinite(position).all(-1)
    return Episode(
        name="one",
        object=ObjectInfo("line", "line"),
        stamps=stamps,
        tracks=Tracks(stamps, position, np.arange(4, dtype=np.uint32), seen, seen.astype(np.float32)),
        grips=Grip(
            torch.as_tensor(place[:, None], dtype=torch.float32),
            quaternion_from_rotation_vector(angle)[:, None].float(),
            torch.ones(frames, 1, dtype=torch.bool),
        ),
        held=np.array([0, 0, -1, -1], np.int32),
        split="train",
        recording=0,
    )


def small_twin(**changes: object) -> Twin:
    return Twin(TwinMeta(), line(4, 0.3), Physics()).replace(**changes)


def test_identity_returns_its_input() -> None:
    e, points = episode(), np.random.default_rng(0).normal(size=(5, 3))
    nothing = Calibration()
    assert nothing.identity and nothing.correct(e) is e
    assert nothing.correct_points(points) is points and nothing.report(points) is points
    assert nothing.then(WRONG) == WRONG and WRONG.then(nothing) == WRONG


def test_a_report_by_hand_and_back() -> None:
    # 2 x (0.1, 0, 0) about the centre, turned by 90 degrees about z: (0, 0.2, 0), then shifted by 1 cm in z.
    wrong = Calibration(scale=2.0, rotation=(0, 0, math.pi / 2), center=(1.0, 1.0, 1.0), translation=(0, 0, 0.01))
    true = np.array([[1.1, 1.0, 1.0], [np.nan] * 3])
    reported = wrong.report(true)
    assert reported[0] == pytest.approx([1.0, 1.2, 1.01], abs=1e-12)
    assert np.isnan(reported[1]).all()
    assert wrong.correct_points(reported)[0] == pytest.approx(true[0], abs=1e-12)
    assert np.isnan(wrong.correct_points(reported)[1]).all()


def test_two_calibrations_become_one() -> None:
    other = dataclasses.replace(WRONG, scale=0.9, rotation=(0.3, 0.0, 0.1), center=(0.0, 0.5, 0.0))
    both = WRONG.then(other)
    points = np.random.default_rng(1).normal(size=(20, 3))
    assert np.abs(both.report(points) - WRONG.report(other.report(points))).max() < 1e-12
    poses = np.random.default_rng(2).normal(size=(20, 3)), np.tile([[0.6, 0.0, 0.8, 0.0]], (20, 1))
    at_once, in_turn = both.correct_pose(*poses), other.correct_pose(*WRONG.correct_pose(*poses))
    assert np.abs(at_once[0] - in_turn[0]).max() < 1e-12 and np.abs(at_once[1] - in_turn[1]).max() < 1e-12
    assert both.delay == pytest.approx(0.1)


def test_a_late_track_meets_the_gripper_of_its_own_time() -> None:
    # Tracks 50 ms (2.5 frames) old: at each corrected stamp the held particle sits at the gripper again.
    e = episode()
    late = np.round(0.05e9).astype(np.int64)
    columns = e.position.reshape(60, 12).T
    reported = np.stack([np.interp(e.stamps - late, e.stamps, c) for c in columns], axis=1).reshape(60, 4, 3)
    wrong = dataclasses.replace(e, tracks=dataclasses.replace(e.tracks, position=reported))
    right = Calibration(delay=0.05).correct(wrong)
    assert len(right.stamps) == 57 and right.stamps[0] == e.stamps[3] - late  # three frames have no pose so early
    gap = right.position[:, 0] - right.grips.position[:, 0].double().numpy()
    assert np.abs(gap).max() < 1e-6  # float32 poses; uncorrected it is 25 mm
    assert np.array_equal(right.tracks.stamp, right.stamps) and len(right.tracks.visible) == 57


def test_late_episodes_begin_at_complete_frames_again() -> None:
    whole = Calibration(delay=0.05).correct(episode(missing=4))
    assert np.isfinite(whole.position[:2]).all() and len(whole.stamps) == 55
    with pytest.raises(DatasetError, match="too short"):
        Calibration(delay=0.5).correct(episode(frames=20))


def test_the_whole_way_round() -> None:
    # Report with everything wrong but the delay, correct, and have the episode back.
    e, wrong = episode(), dataclasses.replace(WRONG, delay=0.0)
    p, q = e.grips.position.double(), e.grips.rotation.double()
    turn = quaternion_from_rotation_vector(torch.tensor(wrong.gripper_rotation, dtype=torch.float64))
    back = quaternion_multiply(q, (turn * torch.tensor([1.0, -1, -1, -1])).expand_as(q))
    offset = quaternion_rotate(back, torch.tensor(wrong.gripper_offset, dtype=torch.float64))
    reported = dataclasses.replace(
        e,
        tracks=dataclasses.replace(e.tracks, position=wrong.report(e.position)),
        grips=Grip((p - offset).float(), back.float(), e.grips.closed),
    )
    right = wrong.correct(reported)
    assert np.nanmax(np.abs(right.position - e.position)) < 1e-12
    assert float((right.grips.position - e.grips.position).abs().max()) < 1e-6
    assert float((right.grips.rotation - e.grips.rotation).abs().max()) < 1e-6


def test_rotation_vectors_and_slerp() -> None:
    vectors = torch.tensor([[0.3, -0.2, 0.9], [0.0, 0.0, 0.0], [1e-9, 0.0, 0.0]], dtype=torch.float64)
    q = quaternion_from_rotation_vector(vectors)
    assert float((quaternion_to_rotation_vector(q) - vectors).abs().max()) < 1e-12
    assert float((quaternion_to_rotation_vector(-q) - vectors).abs().max()) < 1e-12
    half = quaternion_slerp(q[1], q[0], torch.tensor(0.5, dtype=torch.float64))
    assert float((quaternion_to_rotation_vector(half) - 0.5 * vectors[0]).abs().max()) < 1e-12


def test_a_twin_keeps_its_calibration_and_levers(tmp_path: Path) -> None:
    plain = small_twin()
    wrong = plain.replace(
        calibration=WRONG, meta=dataclasses.replace(plain.meta, levers=((0, (0.0, 0.01, 0.0)), (7, (0.1, 0.2, 0.3))))
    )
    wrong.save(tmp_path / "twin")
    loaded = Twin.load(tmp_path / "twin")
    assert loaded.calibration == WRONG and loaded.meta.levers == wrong.meta.levers
    assert loaded.digest() == wrong.digest() != plain.digest()
    plain.save(tmp_path / "twin")  # over it: the identity leaves no file
    assert not (tmp_path / "twin" / "calibration.yaml").exists()
    assert Twin.load(tmp_path / "twin").calibration.identity and Twin.load(tmp_path / "twin").digest() == plain.digest()


@pytest.mark.parametrize(
    ("text", "message"),
    [("delay: {value: 5.0}", "delay"), ("dely: {value: 0.1}", "delay"), ("scale: 1.1", "value"),
     ("rotation: {value: [0, 0]}", "rotation"), ("delay: {value: .nan}", "finite")],
)  # fmt: skip
def test_a_malformed_calibration_is_refused(tmp_path: Path, text: str, message: str) -> None:
    small_twin().save(tmp_path)
    (tmp_path / "calibration.yaml").write_text(text, encoding="utf-8")
    with pytest.raises((ConfigError, DatasetError), match=message):
        Twin.load(tmp_path)


def test_alignment_and_evaluation_use_it() -> None:
    e, body = episode(), line(4, 0.3)
    right = align(e, body, 0.02, Calibration(scale=1.25)).position
    assert float((right - align(e, body, 0.02).position / 1.25).abs().max()) < 1e-6
    one, two = small_twin(calibration=WRONG), small_twin(calibration=Calibration(delay=0.01))
    assert shared_calibration([NamedTwin("", small_twin()), NamedTwin("a", one)]) == WRONG
    with pytest.raises(TwinError, match="different calibrations"):
        shared_calibration([NamedTwin("", one), NamedTwin("a", two)])


def test_levers_of_held_particles() -> None:
    e = episode(missing=4)
    levers = mean_levers([align(e, line(4, 0.3), 0.02)], [0, 1, 2, 3])
    assert [id for id, _ in levers] == [0, 1]
    assert levers[1][1] == pytest.approx((0.02, 0.0, -0.01), abs=1e-6)


def test_live_poses_are_those_of_an_earlier_time() -> None:
    # One pose every 10 ms, x = stamp in s; with a delay of 25 ms the pose stamped 0.03 s is that of 0.005 s.
    def run(delay: float, stamps: list[int]) -> list[tuple[int, float]]:
        poses, turn, got = DelayedPoses(delay, 0.1), np.array([[1.0, 0, 0, 0]]), []
        for t in stamps:
            for p, closed in poses.take(PoseFrame(t, np.array([[t * 1e-9, 0, 0]]), turn), np.array([True])):
                assert closed.all()
                got.append((p.stamp, float(p.position[0, 0])))
        return got

    stamps = [10_000_000 * k for k in range(10)]
    for delay, first in ((0.025, 3), (-0.025, 0), (0.02, 2)):
        got = run(delay, stamps)
        assert [s for s, _ in got] == stamps[first : first + len(got)] and len(got) >= 7
        assert all(x == pytest.approx(s * 1e-9 - delay, abs=1e-12) for s, x in got)
    after = run(0.025, [*stamps, *(1_000_000_000 + s for s in stamps)])  # a hole: nothing is interpolated across it
    assert all(x == pytest.approx(s * 1e-9 - 0.025, abs=1e-12) for s, x in after) and len(after) == 14


def test_observed_effects_are_what_calibration_corrects() -> None:
    place, speed = torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64), torch.tensor([[0.5, 0.0, 0.0]]).double()
    at, center = ObserveContext(Vec3.of(place), Vec3.of(speed)), (0.9, 0.0, 0.8)

    def displaced(id: str, **values: object) -> np.ndarray:
        p = LIBRARY[id].extension(**values).parameters  # type: ignore[arg-type]
        return (place + LIBRARY[id].observe(p, at).tensor()).numpy()

    assert displaced("delay", delay=0.04)[0] == pytest.approx([0.28, -0.2, 0.5], abs=1e-12)
    scaled = Calibration(scale=1.03, center=center).report(place.numpy())
    assert np.abs(displaced("camera_scale", scale=0.03, center=center) - scaled).max() < 1e-12
    turned = Calibration(rotation=(0.01, -0.02, 0.03), center=center).report(place.numpy())
    # What is left out is of third order: 0.037^3 / 6 x 0.7 m = 6 um.
    assert np.abs(displaced("camera_rotation", rotation=(0.01, -0.02, 0.03), center=center) - turned).max() < 1e-5
    for id in ("delay", "camera_scale", "camera_rotation"):
        assert np.array_equal(displaced(id), place.numpy())


def test_poses_between_stamps_turn_evenly() -> None:
    e = episode()
    half = poses_at(e.grips, e.stamps, e.stamps[:-1] + PERIOD // 2)
    angle = quaternion_to_rotation_vector(half.rotation.double())[:, 0, 2].numpy()
    assert angle == pytest.approx((np.arange(59) + 0.5) * 0.02, abs=1e-6)

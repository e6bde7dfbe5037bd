"""The soft beam: conversion, particles that are never seen, and the shipped twin against numbers from the takes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from pred_core.bag.beam import MARKERS, WORLD_FROM_FILE, convert_beam, first_frame, read_beam
from pred_core.bag.dataset import Dataset
from pred_core.bag.measured import find_measured
from pred_core.bag.unseen import complete_line, spline_matrix
from pred_core.cli.main import main
from pred_core.effects.bending_scale import BendingScale
from pred_core.effects.tip_mass import TipMass
from pred_core.errors import DatasetError
from pred_core.evaluate.protocol import predict
from pred_core.frames import quaternion_rotate
from pred_core.springmass import SpringMass
from pred_core.train.recordings import align, gather
from pred_core.twin import Twin

TWIN = Path(__file__).resolve().parents[1] / "config" / "twins" / "soft_beam"
LENGTH = 0.09  # [m] of the made-up beam
measured = pytest.mark.skipif(find_measured("soft_beam") is None, reason="soft_beam.npz is not here (PRED_DATA)")


def _take(frames: int = 200, release: int = 40) -> np.ndarray:
    """(frames, 6, 3) in the file's axes: a beam held level, then turned down by 0.1 rad about the clamp at once."""
    angle = np.where(np.arange(frames) < release, 0.0, 0.1)
    tip = np.array([[0.015, 0.0], [0.0, 0.02], [-0.015, -0.02]])  # up, sideways
    base = np.array([[0.0, 0.02, 0.0], [0.014, -0.02, 0.0], [-0.014, 0.0, 0.0]])
    along = np.stack((-np.sin(angle), np.zeros(frames), np.cos(angle)), axis=1)
    up = np.stack((np.cos(angle), np.zeros(frames), np.sin(angle)), axis=1)
    side = np.array([0.0, 1.0, 0.0])
    points = LENGTH * along[:, None] + tip[None, :, :1] * up[:, None] + tip[None, :, 1:] * side
    return np.concatenate((points, np.broadcast_to(base, (frames, 3, 3))), axis=1).astype(np.float32)


def _npz(path: Path, **changes: object) -> Path:
    arrays: dict[str, object] = {"hz": np.float32(100.0)}
    for name in ("beam_gravity_V2_a", "beam_gravity_V2_b", "beam_load52_V2_a"):
        arrays |= {name: _take(), f"{name}__markers": np.array(MARKERS)}
    arrays |= changes
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})  # type: ignore[arg-type]
    return path


def _convert(path: Path, out: Path, load: int = 0) -> Dataset:
    return convert_beam(read_beam(path, load), out, lambda done, total, name: None)


def test_axes_are_a_rotation_that_turns_the_files_x_up() -> None:
    rotation = np.eye(3)[WORLD_FROM_FILE]
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert (rotation @ [1.0, 0.0, 0.0]).tolist() == [0.0, 0.0, 1.0]  # the file's up
    assert (rotation @ [0.0, 0.0, 1.0]).tolist() == [0.0, 1.0, 0.0]  # along the beam


def test_the_tip_is_followed_from_after_the_release(tmp_path: Path) -> None:
    dataset = _convert(_npz(tmp_path / "x.npz"), tmp_path / "out")
    first = next(dataset.episodes("train"))
    assert len(first.stamps) == 200 - 40 - 20  # released at frame 40, hands off 20 frames later
    assert first.stamps[0] == 1_000_000_000 + 60 * 10_000_000
    turned = np.array([0.0, np.cos(0.1), -np.sin(0.1)])
    np.testing.assert_allclose(first.position[0, -1], LENGTH * turned, atol=1e-7)
    np.testing.assert_allclose(first.position[0, -2], (LENGTH - LENGTH / 6.5) * turned, atol=1e-7)
    # The held edge lies on the axis, its middle in the plane of the clamp's markers: half an edge to either side.
    np.testing.assert_allclose(first.position[0, :2, 1], [-LENGTH / 13, LENGTH / 13], atol=1e-7)
    assert first.held.tolist() == [0, 0] + [-1] * 6
    # Laws of bending read the gripper's y axis, which must lie across the beam.
    across = quaternion_rotate(first.grips.rotation[0, 0], torch.tensor([0.0, 1.0, 0.0]))
    assert abs(float(across[1])) < 1e-6
    assert first.tracks.visible.all(axis=0).tolist() == [True, True] + [False] * 4 + [True, True]
    assert [e.split for e in dataset.entries] == ["train", "test"] and [e.recording for e in dataset.entries] == [0, 1]


def test_the_least_bent_curve_is_the_cubic_of_a_beam_loaded_at_its_end() -> None:
    # Clamped end and end pose given, nothing between: y = s^2 (3 L - s) bends least. The discrete curve has the same
    # second differences, 6 (L - s) up to the grid, so it is exact where the edge at the end has the cubic's slope.
    edges = np.full(20, 0.005)
    s = np.concatenate(([0.0], np.cumsum(edges)))
    y = s**2 * (3.0 * 0.1 - s)
    seen = np.zeros(21, bool)
    seen[[0, 1, -2, -1]] = True
    np.testing.assert_allclose(spline_matrix(edges, seen) @ y[seen], y[~seen], atol=1e-15)


def test_estimates_are_not_scored_and_not_fitted(tmp_path: Path) -> None:
    dataset = _convert(_npz(tmp_path / "x.npz"), tmp_path / "out")
    episode = next(dataset.episodes("train"))
    assert np.isfinite(episode.position).all()
    twin = Twin.load(TWIN)
    recording = align(episode, twin.body, episode.period)
    batch = gather([recording], torch.tensor([[0, 1]]), 5, episode.period, torch.device("cpu"))
    assert torch.isfinite(batch.start.position).all()
    assert batch.seen[:, 0].all(dim=0).tolist() == [True, True] + [False] * 4 + [True, True]


def test_a_line_with_edges_missing_is_refused(tmp_path: Path) -> None:
    episode = next(_convert(_npz(tmp_path / "x.npz"), tmp_path / "out").episodes("train"))
    with pytest.raises(DatasetError, match="2 edges in known rest_length, 8 particles, 4 of them measured"):
        complete_line(episode, {"rest_length": [0.01, 0.01]})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hz": np.float32(50.0)}, "hz"),
        ({"beam_gravity_V2_a": _take()[:, :5]}, "beam_gravity_V2_a"),
        ({"beam_gravity_V2_a": _take(frames=90)}, "no release with 100 frames after it"),
        ({"beam_gravity_V2_a": _take(release=500)}, "no release"),
        ({"beam_gravity_V2_a__markers": np.array(MARKERS[::-1])}, "markers of beam_gravity_V2_a"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        _convert(_npz(tmp_path / "x.npz", **changes), tmp_path / "out")


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = str(_npz(tmp_path / "x.npz")), str(tmp_path / "out")
    assert main(["convert", "beam", path, "--load", "52", "--out", out]) == 0
    assert "1 episodes of 1 takes with 52 g" in capsys.readouterr().out
    assert main(["convert", "beam", path, "--load", "20", "--out", out]) == 2
    assert "no take with this load; got 20 g; allowed: 0, 52 g" in capsys.readouterr().err


def _ring(height: np.ndarray) -> tuple[float, float]:
    """(frequency [Hz], height at rest [m]) of a decaying oscillation at 100 Hz."""
    t = 0.01 * np.arange(len(height))

    def misfit(q: np.ndarray) -> np.ndarray:
        swing = q[2] * np.cos(2 * np.pi * q[3] * t) + q[4] * np.sin(2 * np.pi * q[3] * t)
        return np.asarray(q[0] + np.exp(-q[1] * t) * swing - height)

    ends = [least_squares(misfit, [height[-1], 2.0, height[0] - height[-1], f, 0.0]) for f in (4.5, 7.5)]
    return abs(min(ends, key=lambda r: r.cost).x[3]), float(height[-50:].mean())


@measured
def test_shipped_twin_has_the_measured_frequency_and_sag(tmp_path: Path) -> None:
    path = find_measured("soft_beam")
    assert path is not None
    dataset, twin = _convert(path, tmp_path / "out"), Twin.load(TWIN)
    simulator = SpringMass(
        twin.body, twin.physics, twin.scene, period=twin.meta.period, substeps=twin.meta.substeps,
        extensions=twin.extensions,
    )  # fmt: skip
    for episode in dataset.episodes():
        clamp = episode.position[0, 0, 2]
        simulated, real = predict(simulator, [episode])[0][:, -1, 2] - clamp, episode.position[2:, -1, 2] - clamp
        (f, sag), (f_real, sag_real) = _ring(simulated), _ring(real)
        assert f_real == pytest.approx(7.73, abs=0.03) and -sag_real == pytest.approx(0.0065, abs=0.0001)
        assert f == pytest.approx(f_real, rel=0.02)  # 0.8 %: one stiffness for both; silicone is stiffer when it moves
        assert sag == pytest.approx(sag_real, rel=0.03)
        swing = np.abs(simulated - real)[:100].mean() / np.abs(real - sag_real)[:100].mean()
        assert swing < 0.35  # of the motion in the first second; standing still scores 1


@measured
def test_the_load_slows_the_beam_up_and_down_but_not_sideways(tmp_path: Path) -> None:
    # It hangs: it is lifted with the beam, but need not be pushed aside with it. A softer beam would be slower both
    # ways, and a weight fixed to the tip too: sideways it would swing at the 4.4 Hz of up and down, not near 7.8 Hz.
    path = find_measured("soft_beam")
    assert path is not None
    for load, up in ((0, 7.73), (52, 4.35)):
        for take in read_beam(path, load).takes:
            tip = take.tip.mean(axis=1)[first_frame(take) :]
            assert _ring(tip[:, 2])[0] == pytest.approx(up, rel=0.015)
            frequency = np.fft.rfftfreq(4096, 0.01)
            spectrum = np.abs(np.fft.rfft((tip[:, 0] - tip[:, 0].mean()) * np.hanning(len(tip)), 4096))
            slow, fast = ((frequency > low) & (frequency < high) for low, high in ((4.0, 4.8), (6.0, 9.0)))
            assert spectrum[slow].max() < 0.4 * spectrum[fast].max()


@measured
def test_added_mass_at_the_tip_and_a_softer_beam_part_where_sag_and_frequency_meet(tmp_path: Path) -> None:
    # Mass or stiffness changed everywhere: sag ~ m/k and f^2 ~ k/m, their product stays. Mass added at the tip moves
    # more in the mode than it sags: a uniform cantilever has sag (2 pi f)^2 = 12.4/8 g, a massless one with all its
    # mass at the end 1 g. So with the sag of the loaded beam the tip mass swings slower than the softer beam.
    path = find_measured("soft_beam")
    assert path is not None
    twin, real = Twin.load(TWIN), {}
    for load in (0, 52):
        episode = next(_convert(path, tmp_path / str(load), load).episodes("train"))
        real[load] = _ring(episode.position[2:, -1, 2] - episode.position[0, 0, 2])
    assert _product(real[0]) == pytest.approx(12.4 / 8, rel=0.05)
    assert 1.15 < _product(real[52]) < 1.35
    changed = {}
    for effect in (TipMass.extension(change=8.2), BendingScale.extension(change=-0.629)):
        simulator = SpringMass(
            twin.body, twin.physics, twin.scene, period=twin.meta.period, extensions=(*twin.extensions, effect)
        )
        simulated = predict(simulator, [episode])[0][:, -1, 2] - episode.position[0, 0, 2]
        changed[effect.id] = _ring(simulated)
        assert changed[effect.id][1] == pytest.approx(real[52][1], rel=0.02)
    assert _product(changed["bending_scale"]) == pytest.approx(_product(real[0]), rel=0.06)
    slow, fast = changed["tip_mass"][0], changed["bending_scale"][0]
    assert slow < real[52][0] < fast and real[52][0] - slow < 0.7 * (fast - real[52][0])


def _product(ring: tuple[float, float]) -> float:
    """Sag times squared angular frequency over gravity."""
    return -ring[1] * (2 * np.pi * ring[0]) ** 2 / 9.81

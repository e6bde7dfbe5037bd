"""Each metric beside a number worked out by hand; variants are told apart; hidden particles are counted."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pred_core import metrics
from pred_core.errors import InputError
from pred_core.metrics.chamfer_batch import by_distance_matrix, chamfer_two_sided_batch
from pred_core.metrics.lpips import Lpips

# Two points; prediction off by (3, 4, 0) and by (0, 0, 1).
MEASURED = np.zeros((2, 3))
PREDICTED = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]])


def test_mde_is_the_mean_euclidean_distance():
    assert metrics.mde(PREDICTED, MEASURED) == pytest.approx((5.0 + 1.0) / 2)


def test_coordinate_l1_is_the_mean_over_all_coordinates():
    assert metrics.coordinate_l1(PREDICTED, MEASURED) == pytest.approx((3 + 4 + 0 + 0 + 0 + 1) / 6)


def test_hidden_particles_are_left_out_and_counted():
    measured = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    assert metrics.mde(PREDICTED, measured) == pytest.approx(5.0)
    visible = np.array([False, True])
    assert metrics.mde(PREDICTED, MEASURED, visible) == pytest.approx(1.0)
    assert metrics.hidden_count(measured) == 1
    assert metrics.hidden_count(measured, visible) == 2
    assert np.isnan(metrics.mde(PREDICTED, measured, visible)), "a frame without measurement has no score"


def test_prediction_that_is_not_finite_is_never_averaged():
    with pytest.raises(InputError, match="not finite"):
        metrics.mde(np.full((2, 3), np.inf), MEASURED)


def test_chamfer_by_hand_and_two_sided():
    # a = {0}, b = {0, 10}: a->b is 0; b->a is (0 + 10) / 2. A one-sided distance would not see the far point.
    a, b = np.zeros((1, 3)), np.array([[0.0, 0, 0], [10.0, 0, 0]])
    assert metrics.chamfer_one_sided(a, b) == 0.0
    assert metrics.chamfer_one_sided(b, a) == pytest.approx(5.0)
    assert metrics.chamfer_two_sided(a, b) == pytest.approx(5.0)
    assert metrics.chamfer_two_sided(b, a) == pytest.approx(5.0)
    assert metrics.chamfer_two_sided_squared(a, b) == pytest.approx(50.0)


@pytest.mark.parametrize("sizes", [(1, 1), (3, 17), (40, 33), (16, 4)])
def test_batched_chamfer_equals_the_plain_one(sizes):
    # float32 coordinates of 1 m: rounding 1e-7 m, far below 1e-5.
    generator = torch.Generator().manual_seed(1)
    a = torch.rand(5, sizes[0], 3, generator=generator)
    b = torch.rand(5, sizes[1], 3, generator=generator)
    expected = [metrics.chamfer_two_sided(x.double().numpy(), y.double().numpy()) for x, y in zip(a, b, strict=True)]
    assert np.allclose(chamfer_two_sided_batch(a, b).numpy(), expected, atol=1e-5)
    shared = [metrics.chamfer_two_sided(x.double().numpy(), b[0].double().numpy()) for x in a]
    assert np.allclose(chamfer_two_sided_batch(a, b[:1]).numpy(), shared, atol=1e-5)
    # The form used on CUDA, here on CPU.
    assert np.allclose(by_distance_matrix(a, b).numpy(), expected, atol=1e-5)
    assert np.allclose(by_distance_matrix(a, b[:1]).numpy(), shared, atol=1e-5)


def test_batched_chamfer_sees_both_sides():
    a, b = torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0, 0], [10.0, 0, 0]]])
    assert chamfer_two_sided_batch(a, b).item() == pytest.approx(5.0)
    assert chamfer_two_sided_batch(b, a).item() == pytest.approx(5.0)
    with pytest.raises(InputError, match="not finite"):
        chamfer_two_sided_batch(a * torch.nan, b)


def test_emd_matches_each_point_once():
    # On a line: {0, 1} to {1, 2}. Nearest neighbours would say 0 for the shared point; matching moves both by 1.
    a, b = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 0], [2.0, 0, 0]])
    assert metrics.emd(a, b) == pytest.approx(1.0)
    # Rectangular: the third point of the larger cloud stays unmatched.
    assert metrics.emd(a, np.vstack([a, [[9.0, 0, 0]]])) == pytest.approx(0.0)
    with pytest.raises(InputError, match="not finite"):
        metrics.emd(a, np.array([[np.nan, 0, 0]]))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 12))
def test_chamfer_is_at_most_twice_emd_and_mde_bounds_emd(seed, count):
    # A matching is one way to pair points, so nearest neighbours are never farther; identity is one matching.
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, count, 3))
    assert metrics.chamfer_two_sided(a, b) <= 2 * metrics.emd(a, b) + 1e-12
    assert metrics.emd(a, b) <= metrics.mde(a, b) + 1e-12


def test_region_j_by_hand():
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    a[0, :3], b[0, 1:4] = True, True  # 2 shared of 4
    assert metrics.region_j(a, b) == pytest.approx(0.5)
    assert metrics.region_j(a * False, b * False) == 1.0
    with pytest.raises(InputError, match="shape"):
        metrics.region_j(a, b[:3])


def test_contour_f_tolerance_is_the_rounded_up_share_of_the_diagonal():
    # 100 x 100: diagonal 141.4, 0.8 % = 1.13, so the tolerance is 2 pixels.
    a, near, far = (np.zeros((100, 100), bool) for _ in range(3))
    a[20:60, 20:60], near[22:62, 20:60], far[63:99, 63:99] = True, True, True
    assert metrics.contour_f(a, near) == pytest.approx(1.0)
    assert metrics.contour_f(a, far) == 0.0
    three = np.zeros_like(a)
    three[23:63, 20:60] = True
    # Top and bottom edge are off by 3; the sides still match, except 3 rows minus what the corner reaches.
    assert 0.4 < metrics.contour_f(a, three) < 0.8
    assert metrics.contour_f(a, a * False) == 0.0


def test_psnr_by_hand():
    # Error 0.1 everywhere: mean square 0.01, so 20 dB.
    image = np.full((8, 8, 3), 0.5)
    assert metrics.psnr(image, image + 0.1) == pytest.approx(20.0)
    assert metrics.psnr(image, image) == math.inf
    with pytest.raises(InputError, match="0 to 1"):
        metrics.psnr(image * 255, image * 255)


def test_ms_ssim_of_a_brightness_shift_by_hand():
    # Constant images: variances and covariance are 0, so every contrast term is 1 and only the luminance term of the
    # coarsest scale is left: ((2 a b + C1) / (a^2 + b^2 + C1)) ** 0.1333.
    a, b = np.full((176, 180), 0.4), np.full((176, 180), 0.6)
    expected = ((2 * 0.24 + 1e-4) / (0.16 + 0.36 + 1e-4)) ** 0.1333
    assert metrics.ms_ssim(a, b) == pytest.approx(expected, abs=1e-9)
    assert metrics.ms_ssim(a, a) == pytest.approx(1.0)
    with pytest.raises(InputError, match="too small"):
        metrics.ms_ssim(a[:100], b[:100])


def test_ms_ssim_falls_with_noise():
    rng = np.random.default_rng(0)
    image = np.clip(rng.normal(0.5, 0.1, (180, 180)), 0, 1)
    noise = rng.normal(size=image.shape)
    scores = [metrics.ms_ssim(image, np.clip(image + s * noise, 0, 1)) for s in (0.01, 0.05, 0.2)]
    assert 1 > scores[0] > scores[1] > scores[2] > 0


def test_lpips_is_not_computed_without_weights_and_refuses_others(tmp_path):
    assert metrics.load_lpips(None) is None
    wrong = tmp_path / "alex.pth"
    wrong.write_bytes(b"not the weights")
    with pytest.raises(InputError, match="sha256 differs"):
        metrics.load_lpips(metrics.LpipsFiles(wrong, wrong, "0" * 64))
    with pytest.raises(InputError, match="no such weight file"):
        metrics.load_lpips(metrics.LpipsFiles(tmp_path / "none.pth", wrong, "0" * 64))


def test_lpips_loads_files_whose_hash_agrees(tmp_path):
    import hashlib

    generator = torch.Generator().manual_seed(0)
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
    backbone = {f"features.{i}.weight": 0.05 * torch.randn(s, generator=generator) for i, s in shapes.items()}
    backbone |= {f"features.{i}.bias": torch.zeros(s[0]) for i, s in shapes.items()}
    linear = {f"lin{i}.model.1.weight": torch.ones(1, s[0], 1, 1) for i, s in enumerate(shapes.values())}
    paths = [tmp_path / "alexnet.pth", tmp_path / "alex.pth"]
    for path, tensors in zip(paths, (backbone, linear), strict=True):
        torch.save(tensors, path)
    digests = [hashlib.sha256(p.read_bytes()).hexdigest() for p in paths]
    model = metrics.load_lpips(metrics.LpipsFiles(*paths, linear_sha256=digests[1], backbone_sha256=digests[0]))
    assert isinstance(model, Lpips)
    image = torch.rand(3, 64, 64, generator=generator) * 2 - 1
    assert model(image, image).item() == 0.0
    assert model(image, -image).item() > 0.0
    # Unit-length features and unit weights: each layer adds at most |u - v|^2 <= 2 (features are not negative).
    assert model(image, -image).item() <= 5 * 2.0
    with pytest.raises(InputError, match="range"):
        model(image * 3, image)
    swapped = metrics.LpipsFiles(paths[1], paths[0], linear_sha256=digests[0], backbone_sha256=digests[1])
    with pytest.raises(InputError, match="tensors are missing"):
        metrics.load_lpips(swapped)

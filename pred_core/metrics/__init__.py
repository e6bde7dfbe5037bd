"""Every score under its full variant name; see the modules for definitions and units."""

from pred_core.metrics.chamfer import chamfer_one_sided, chamfer_two_sided, chamfer_two_sided_squared
from pred_core.metrics.correspondence import coordinate_l1, hidden_count, masked_mean, mde, scored
from pred_core.metrics.emd import emd
from pred_core.metrics.images import ms_ssim, psnr
from pred_core.metrics.lpips import NOT_COMPUTED, Lpips, LpipsFiles, load_lpips
from pred_core.metrics.masks import contour_f, region_j

__all__ = [
    "NOT_COMPUTED",
    "Lpips",
    "LpipsFiles",
    "chamfer_one_sided",
    "chamfer_two_sided",
    "chamfer_two_sided_squared",
    "contour_f",
    "coordinate_l1",
    "emd",
    "hidden_count",
    "load_lpips",
    "masked_mean",
    "mde",
    "ms_ssim",
    "psnr",
    "region_j",
    "scored",
]

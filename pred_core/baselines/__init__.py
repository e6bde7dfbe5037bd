"""Dynamics without physics or learning; every accuracy table carries them."""

from pred_core.baselines.blended_ends import BlendedEnds
from pred_core.baselines.constant_velocity import ConstantVelocity
from pred_core.baselines.last_residual import LastResidual
from pred_core.baselines.persistence import Persistence
from pred_core.baselines.static_regression import StaticRegression, fit_static_regression

__all__ = [
    "BlendedEnds",
    "ConstantVelocity",
    "LastResidual",
    "Persistence",
    "StaticRegression",
    "fit_static_regression",
]

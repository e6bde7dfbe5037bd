"""MPPI (Williams et al. 2017; paper III-E): sample around a mean, weigh by exp(-cost / temperature), move the mean.

Three departures, each said where it acts: the temperature is a share of the spread of the costs, so that the weights do
not change when all costs are scaled or shifted; the samples of one iteration are drawn from narrow to wide noise, so
that the same iteration explores and refines, and narrower from iteration to iteration; the best sample ever evaluated is kept, so that time can only help.
"""

from __future__ import annotations

import numpy as np

from pred_core.errors import DivergenceError
from pred_core.plan.config import SearchConfig
from pred_core.types import Array


def draw_noise(
    config: SearchConfig, shape: tuple[int, int, int, int], iteration: int, generator: np.random.Generator
) -> Array:
    """Noise (M, K, G, 4) [m/s], [rad/s]: neighbouring knots are correlated; sample 0 has none.

    Sample k of iteration i has the standard deviation of the configuration times shrink^i finest^(k / (K - 1)).
    """
    noise = generator.standard_normal(shape)
    rho = config.correlation
    fresh = np.sqrt(1.0 - rho * rho)
    for i in range(1, shape[0]):
        noise[i] = rho * noise[i - 1] + fresh * noise[i]
    noise[..., :3] *= config.noise
    noise[..., 3] *= config.turn_noise
    noise *= config.shrink**iteration * (config.finest ** np.linspace(0.0, 1.0, shape[1]))[:, None, None]
    noise[:, 0] = 0.0
    return noise


def weigh(costs: Array, temperature: float) -> Array:
    """Weights (K,) that sum to 1 of costs (K,); infinite and NaN costs weigh nothing.

    The temperature counts in units of median less least cost of the finite ones.
    Raises: DivergenceError if no cost is finite.
    """
    finite = np.isfinite(costs)
    if not finite.any():
        raise DivergenceError(
            f"none of {len(costs)} planned motions could be simulated",
            next_step="Check the twin, the state and the speed limit of the plan",
        )
    least = costs[finite].min()
    scale = temperature * (np.median(costs[finite]) - least)
    above = np.where(finite, costs, np.inf) - least
    if scale <= 0.0:  # half of the samples are equally good
        weights = (above <= 0.0).astype(float)
    else:
        weights = np.exp(-above / scale)
    return np.asarray(weights / weights.sum())


def move_mean(samples: Array, costs: Array, temperature: float) -> Array:
    """The next mean (M, G, 4) from samples (M, K, G, 4) and costs (K,). Raises: DivergenceError; see `weigh`."""
    return np.tensordot(samples, weigh(costs, temperature), axes=(1, 0))

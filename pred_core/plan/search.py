"""MPPI (Williams et al. 2017; paper III-E): sample around a mean, weigh by exp(-cost / temperature), move the mean.

Three departures: the temperature is a share of the spread of the costs, so that the weights do not change when all
costs are scaled or shifted; the samples of one iteration are drawn from wide to narrow noise, and narrower from
iteration to iteration, so that a plan explores and refines; the planner sends the best motion it has simulated, not
the mean, so that more time never makes a plan worse and what is sent is what was judged.
"""

from __future__ import annotations

import functools

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
    deviation = np.array([config.noise, config.noise, config.noise, config.turn_noise])
    narrower = config.shrink**iteration * config.finest ** (np.arange(shape[1]) / max(shape[1] - 1, 1))
    narrower[0] = 0.0
    white = generator.standard_normal(shape)
    noise = (_correlated(shape[0], config.correlation) @ white.reshape(shape[0], -1)).reshape(shape)
    noise *= narrower[:, None, None] * deviation
    return noise


@functools.lru_cache(maxsize=32)
def _correlated(count: int, rho: float) -> Array:
    """(M, M): white noise to noise of the same variance whose neighbours correlate by rho."""
    powers = np.arange(count)[:, None] - np.arange(count)
    rows = np.where(powers >= 0, rho ** np.maximum(powers, 0), 0.0)
    rows[:, 1:] *= np.sqrt(1.0 - rho * rho)
    return rows


def weigh(costs: Array, temperature: float) -> Array:
    """Weights (K,) that sum to 1 of costs (K,); infinite and NaN costs weigh nothing.

    The temperature counts in units of median (the upper one of two) less least cost of the finite ones.
    Raises: DivergenceError if no cost is finite.
    """
    finite = np.isfinite(costs)
    if not finite.any():
        raise DivergenceError(
            f"none of {len(costs)} planned motions could be simulated",
            next_step="Check the twin, the state and the speed limit of the plan",
        )
    ordered = np.sort(costs[finite])
    least = ordered[0]
    scale = temperature * (ordered[len(ordered) // 2] - least)
    above = np.where(finite, costs, np.inf) - least
    # No scale: at least half of the samples are equally good.
    weights = np.exp(-above / scale) if scale > 0.0 else (above <= 0.0).astype(float)
    return np.asarray(weights / weights.sum())


def move_mean(samples: Array, costs: Array, temperature: float) -> Array:
    """The next mean (M, G, 4) from samples (M, K, G, 4) and costs (K,). Raises: DivergenceError; see `weigh`."""
    flat = samples.reshape(*samples.shape[:2], -1)
    return (weigh(costs, temperature) @ flat).reshape(samples.shape[0], *samples.shape[2:])

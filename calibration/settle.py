"""Gauss-Newton in rounds: each is linear about the last one's result, robust, with priors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from noise_model.arrays import Float64
from noise_model.fit import Fit, Parameter, fit, within_bounds

MAX_ROUNDS, MIN_SHARE, SETTLED = 20, 0.05, 0.02
"""A fit's rounds at most, the least share of a round's step that is tried, and the gain in squares that is
the last round's."""


def settled(
    parameters: Sequence[Parameter],
    residuals: Callable[[Float64], Float64],
    derivatives: Callable[[Float64, Float64], Float64],
    start: Float64,
    huber: float,
    rounds: int = MAX_ROUNDS,
) -> Fit:
    """Return the fit of parameters (p,) to whitened residuals (n,) from a start (p,) on.

    `derivatives` gives those (n, p) of the residuals at parameters (p,), where they are (n,). A step that
    gains nothing is shortened.
    """
    sigmas = np.array([parameter.prior_sigma for parameter in parameters])
    means = np.array([parameter.start for parameter in parameters])
    x, r = start, residuals(start)
    for _ in range(rounds):
        result = linear_fit(parameters, r, derivatives(x, r), x, huber)
        before, share = robust_cost(r, (x - means) / sigmas, huber), 1.0
        while True:
            there = within_bounds(parameters, x + share * (result.values - x))
            r_there = residuals(there)
            gain = before - robust_cost(r_there, (there - means) / sigmas, huber)
            if gain > 0.0 or share < MIN_SHARE:
                break
            share *= 0.5
        if gain > 0.0:
            x, r = there, r_there
        if gain < SETTLED:
            break
    return replace(result, values=x, residuals=r)


def linear_fit(
    parameters: Sequence[Parameter], residuals: Float64, J: Float64, x: Float64, huber: float
) -> Fit:
    """Return the fit of parameters (p,) to residuals (n,) that are linear about `x` (p,), by J (n, p)."""
    return fit(parameters, partial(_linear, residuals, J, x), huber=huber, start=x)


def robust_cost(residuals: Float64, pulls: Float64, huber: float) -> float:
    """Return Huber's sum over residuals (n,) and the squares of the priors' pulls (p,)."""
    size = np.abs(residuals)
    beyond = 2.0 * huber * size - huber**2
    return float(np.where(size > huber, beyond, size**2).sum() + (pulls**2).sum())


def _linear(residuals: Float64, J: Float64, x: Float64, there: Float64) -> Float64:
    return np.asarray(residuals + J @ (there - x))

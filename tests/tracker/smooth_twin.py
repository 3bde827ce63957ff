"""The smoothed stripe again, by matrices: every window's line is a least-squares solution of its own."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from noise_model.compiled.arrays import Float64
from tracker.stripe.smooth import (
    AGREE_SIGMAS,
    LENGTHS,
    MAX_MISSING,
    MIN_DRAWN,
    MIN_SURE_PX,
    OUTLIER_PX,
    OUTLIER_REACH,
    OUTLIER_SIGMAS,
    PIECE_CHI2,
)

NOTHING = (np.nan, np.nan, np.nan)


def line(
    y: Float64, sigma: Float64, low: int, high: int, at: float = 0.0
) -> tuple[np.floating, np.floating, np.floating] | tuple[float, float, float]:
    """Value and variance at a column, and chi2, of the line through columns low to high - 1."""
    low, high = max(low, 0), min(high, len(y))
    columns = np.flatnonzero(np.isfinite(y[low:high])) + low
    if len(columns) < 2:
        return NOTHING
    A = np.stack([np.ones(len(columns)), columns - at], axis=1) / sigma[columns, np.newaxis]
    b = y[columns] / sigma[columns]
    solution, *_ = np.linalg.lstsq(A, b, rcond=None)
    return solution[0], np.linalg.inv(A.T @ A)[0, 0], np.sum((A @ solution - b) ** 2)


def straightness(y: Float64, sigma: Float64) -> Callable[[int, int], bool]:
    """Return what says whether the window of a length that starts at a column is straight.

    The windows of neighbouring columns overlap: each is fitted once.
    """

    @cache
    def chi2(low: int, high: int) -> float:
        return float(line(y, sigma, low, high)[2])

    @cache
    def is_straight(low: int, length: int) -> bool:
        if low < 0 or low + length > len(y):
            return False
        whole = chi2(low, low + length)
        if length == LENGTHS[0]:
            missing = np.isnan(y[low : low + length]).sum()
            return bool(missing <= MAX_MISSING and whole <= PIECE_CHI2)
        half = length // 2
        parts = [low, low + half // 2, low + half]
        if not all(is_straight(part, half) for part in parts):
            return False
        halves = chi2(low, low + half) + chi2(low + half, low + length)
        return bool(whole - halves <= PIECE_CHI2)

    return is_straight


def is_outlier(y: Float64, sigma: Float64, i: int) -> bool:
    def off(value: float, variance: float) -> float:
        """How many sigmas the column is off, 0 where it is near."""
        away = abs(y[i] - value)
        return float(away / np.sqrt(sigma[i] ** 2 + variance)) if away > OUTLIER_PX else 0.0

    sides = [line(y, sigma, i - OUTLIER_REACH, i, i)[:2], line(y, sigma, i + 1, i + 1 + OUTLIER_REACH, i)[:2]]
    sides = [side for side in sides if np.isfinite(side[0])]
    if not sides:
        return False
    offs = [off(*side) for side in sides]
    values, variances = np.array(sides).T
    if len(sides) == 2 and abs(np.diff(values)[0]) <= AGREE_SIGMAS * np.sqrt(variances.sum()):
        weights = 1.0 / variances
        both = off(float(np.average(values, weights=weights)), float(1.0 / weights.sum()))
        return both > OUTLIER_SIGMAS and min(offs) > AGREE_SIGMAS
    return min(offs) > OUTLIER_SIGMAS


def smooth_stripe(y: Float64, sigma: Float64) -> tuple[Float64, Float64]:
    good = np.array([np.isfinite(y[i]) and not is_outlier(y, sigma, i) for i in range(len(y))])
    y, sigma = np.where(good, y, np.nan), np.where(good, sigma, np.nan)
    smooth, smooth_sigma = y.copy(), sigma.copy()
    is_straight = straightness(y, sigma)
    for i in np.flatnonzero(good):
        found = []
        for length in sorted(LENGTHS, reverse=True):
            for quarters in ((2,), (1, 3)):
                for q in quarters:
                    if length >= MIN_DRAWN and is_straight(i - q * length // 4, length):
                        first = i - q * length // 8
                        found.append(line(y, sigma, first, first + length // 2 + 1, i)[:2])
                found = [one for one in found if one[1] < sigma[i] ** 2]
                if found:
                    break
            if found:
                break
        if found:
            value, variance = min(found, key=lambda one: one[1])
            smooth[i], smooth_sigma[i] = value, np.sqrt(variance)
    unsure = smooth_sigma > MIN_SURE_PX
    return np.where(unsure, np.nan, smooth), np.where(unsure, np.nan, smooth_sigma)

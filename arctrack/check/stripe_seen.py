"""Width, peak, saturation and speckle of a bright line, without any model."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates, median_filter
from scipy.optimize import curve_fit

from arctrack.check.bright_line import BrightLine
from noise_model.compiled.arrays import Float64, Integers
from noise_model.instrument.sensor import Sensor, linearise, saturation_dn, variance_e2
from noise_model.robust import spread

REACH_SCALES = 6.0
"""Half-width of a line's window, in the sigma that shows it best; the outer third is background."""

SMOOTH_LINES = 31
"""Window that smooths a line's position and brightness, scan lines: the residual is scatter."""

MIN_LINES = 20
"""Least number of scan lines of a measurement."""


@dataclass(frozen=True)
class StripeMeasurement:
    """A stripe as it is in the image; NaN where undetermined.

    `sigma_px` is its 1 sigma, `peak_e` its peak over the background, both of the median scan line;
    `saturated_share` is the share of the lines with a saturated pixel: these count for nothing else.
    `contrast` is the relative scatter of its brightness from line to line, beyond photon and sensor noise.
    """

    sigma_px: float
    peak_e: float
    saturated_share: float
    contrast: float


UNSEEN = StripeMeasurement(math.nan, math.nan, math.nan, math.nan)


def stripe_seen(image_dn: Integers, sensor: Sensor, line: BrightLine) -> StripeMeasurement:
    """Measure the stripe of an image (H, W), DN, about a line that was found in it."""
    if len(line.scan) < MIN_LINES:
        return UNSEEN
    scan_lines_dn = np.minimum(image_dn.T if line.along_rows else image_dn, sensor.max_dn)
    reach = math.ceil(REACH_SCALES * line.scale_px)
    offsets = np.arange(-reach, reach + 1.0)
    # The peaks of single lines are where noise is highest: about them a stripe would look narrow and bright.
    center = median_filter(line.positions_px, SMOOTH_LINES, mode="nearest")
    positions = center[:, np.newaxis] + offsets
    inside = (positions[:, 0] >= 0.0) & (positions[:, -1] <= scan_lines_dn.shape[1] - 1)
    if inside.sum() < MIN_LINES:
        return UNSEEN
    grid = np.stack([np.broadcast_to(line.scan[:, np.newaxis], positions.shape)[inside], positions[inside]])
    nearest_dn = map_coordinates(scan_lines_dn, grid, order=0)
    clipped = (nearest_dn >= saturation_dn(sensor)).any(axis=1)
    charge_e = map_coordinates(linearise(scan_lines_dn, sensor), grid, order=1)
    charge_e -= np.median(charge_e[:, np.abs(offsets) > 2.0 / 3.0 * reach], axis=1)[:, np.newaxis]
    share = float(clipped.mean())
    if (~clipped).sum() < MIN_LINES:
        return StripeMeasurement(math.nan, math.nan, share, math.nan)
    sigma_px, peak_e = _bell(offsets, np.median(charge_e[~clipped], axis=0), line.scale_px)
    return StripeMeasurement(
        sigma_px, peak_e, share, _contrast(offsets, charge_e[~clipped], sigma_px, sensor)
    )


def _bell(offsets_px: Float64, profile_e: Float64, start_px: float) -> tuple[float, float]:
    """Fit a Gaussian over an even background to a profile (n,); return its sigma and its peak."""

    def bell(x: Float64, peak: float, middle: float, sigma: float, base: float) -> Float64:
        return np.asarray(peak * np.exp(-0.5 * ((x - middle) / sigma) ** 2) + base)

    start = (float(profile_e.max()), 0.0, start_px, 0.0)
    try:
        (peak, _, sigma, _), _ = curve_fit(bell, offsets_px, profile_e, start)
    except RuntimeError:
        return math.nan, math.nan
    sigma = abs(float(sigma))
    return (sigma, float(peak)) if peak > 0.0 and sigma < offsets_px[-1] else (math.nan, math.nan)


def _contrast(offsets_px: Float64, charge_e: Float64, sigma_px: float, sensor: Sensor) -> float:
    """Return how much the brightness of lines (n, k) scatters, relative, noise taken off."""
    if not math.isfinite(sigma_px):
        return math.nan
    weights = np.exp(-0.5 * (offsets_px / sigma_px) ** 2)
    weights /= weights @ weights
    brightness_e = charge_e @ weights
    smooth_e = median_filter(brightness_e, SMOOTH_LINES, mode="nearest")
    known = smooth_e > 0.0
    if known.sum() < MIN_LINES:
        return math.nan
    ratio = brightness_e[known] / smooth_e[known]
    scatter = spread(ratio)
    noise_e2 = variance_e2(charge_e, sensor) @ weights**2
    noise = float(np.median(noise_e2[known] / smooth_e[known] ** 2))
    return math.sqrt(max(scatter**2 - noise, 0.0))

"""Black level and noise of a sensor where no light falls on it, from its darkest frames."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from arctrack.check.bright_line import BrightLine
from noise_model.compiled.arrays import Bool, Float64, Integers

TAIL = 0.05
"""This share of the pixels at either end is left out: hot ones, dead ones, what little is lit."""

CLIP_SIGMAS, ROUNDS = 4.0, 5
"""Differences beyond are no noise, and in how many rounds that settles."""

KEEP_OFF_SCALES = 8.0
"""Distance of dark pixels from a line, in its sigmas."""


@dataclass(frozen=True)
class SensorReading:
    """Black level and noise of dark pixels, DN, NaN if unknown; `is_dark`: laser and arc were off."""

    black_dn: float
    noise_dn: float
    is_dark: bool


def sensor_seen(
    dark_dn: Sequence[Integers], lit_dn: Sequence[Integers], lines: Sequence[BrightLine]
) -> SensorReading:
    """Measure dark frames (H, W), DN, or without them frames with the laser alone, off its line.

    Without either nothing is known.
    """
    images = list(dark_dn) or list(lit_dn)
    if not images:
        return SensorReading(math.nan, math.nan, is_dark=False)
    masks = [np.ones(image.shape, dtype=np.bool_) for image in dark_dn]
    if not masks:
        masks = [_off_line(image, line) for image, line in zip(lit_dn, lines, strict=True)]
    black = [_middle(image[mask]) for image, mask in zip(images, masks, strict=True) if mask.any()]
    noise = [_noise(image, mask) for image, mask in zip(images, masks, strict=True) if mask.any()]
    if not black:
        return SensorReading(math.nan, math.nan, is_dark=False)
    return SensorReading(float(np.median(black)), float(np.median(noise)), is_dark=bool(dark_dn))


def _off_line(image_dn: Integers, line: BrightLine) -> Bool:
    """Return which pixels (H, W) lie far from a line."""
    mask = np.ones(image_dn.shape, dtype=np.bool_)
    scan_lines = mask.T if line.along_rows else mask
    reach = math.ceil(KEEP_OFF_SCALES * line.scale_px)
    for scan, position in zip(line.scan, np.rint(line.positions_px).astype(np.int64), strict=True):
        scan_lines[scan, max(0, position - reach) : position + reach + 1] = False
    return mask


def _middle(values_dn: Integers) -> float:
    """Return the mean of values without their tails: a median knows no tenths of a code."""
    low, high = np.quantile(values_dn, [TAIL, 1.0 - TAIL])
    return float(values_dn[(values_dn >= low) & (values_dn <= high)].mean())


def _noise(image_dn: Integers, mask: Bool) -> float:
    """Return the noise of an image's pixels from what neighbours differ by, whatever is behind them."""
    off: Float64 = np.diff(image_dn.astype(np.float64), axis=1)[mask[:, 1:] & mask[:, :-1]]
    for _ in range(ROUNDS):
        if not off.size:
            return math.nan
        off = off[np.abs(off - off.mean()) <= max(CLIP_SIGMAS * float(off.std()), 1.0)]
    return float(off.std()) / math.sqrt(2.0)


def median(values: Iterable[float]) -> float:
    """Return the median of the values that are known, NaN for none."""
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan

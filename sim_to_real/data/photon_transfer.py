"""The noise that a recording shows, level by level: its photon transfer curve.

A sensor whose response or read noise is not as stated has another noise, too. That noise shows in the mixed
second differences of neighbouring pixels, which vanish for smooth light. (EMVA Standard 1288 takes
differences of two frames.)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from noise_model.compiled.arrays import Bool, Float64, Integers
from sim_to_real.data.blocks import DETAIL_2X2, block_means, weighted_sums_in_bins


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """The variance of a pixel's noise (k,), DN^2, at grey levels (k,), DN; empty if none was measured."""

    levels_dn: Float64
    variances_dn2: Float64

    def variance_at(self, levels_dn: Float64) -> Float64:
        """Return the variance (...,), DN^2, at levels (...,), DN; outside the range that of the nearest."""
        if not len(self.levels_dn):
            return np.zeros_like(levels_dn)
        return np.interp(levels_dn, self.levels_dn, self.variances_dn2)


def photon_transfer(images_dn: Sequence[Integers], usable: Sequence[Bool], bin_px: int) -> PhotonTransfer:
    """Measure the noise of frames (H, W) in bins `bin_px` wide; those count that are `usable` (h, w).

    Each level's variance is the median over bins of their details' mean square: flanks of stripes and edges
    scatter more, but are few.
    """
    level, variance = (
        np.concatenate(values)
        for values in zip(
            *(_of_bins(image, use, bin_px) for image, use in zip(images_dn, usable, strict=True)), strict=True
        )
    )
    # A level's median takes 500 bins; there are 24 levels at most.
    min_bins = 500
    if len(level) < min_bins:
        return PhotonTransfer(np.empty(0), np.empty(0))
    order = np.argsort(level, kind="stable")
    parts = np.array_split(order, min(24, len(level) // min_bins))
    # The median of a mean of squares of normal variables lies below its expectation.
    squares = (bin_px // 2) ** 2
    median_ratio = float(chi2.median(squares)) / squares
    return PhotonTransfer(
        np.array([np.median(level[part]) for part in parts], dtype=np.float64),
        np.array([np.median(variance[part]) / median_ratio for part in parts], dtype=np.float64),
    )


def _of_bins(image_dn: Integers, usable: Bool, bin_px: int) -> tuple[Float64, Float64]:
    """Return means (n,), DN, and variances (n,), DN^2, of a frame's bins that are usable."""
    small = weighted_sums_in_bins(image_dn.astype(np.float32), DETAIL_2X2, bin_px)[usable]
    return block_means(image_dn, bin_px)[usable], np.mean(small**2, axis=-1, dtype=np.float64)

"""JPEG compression of a frame: blocks of 8 x 8 pixels whose cosine transform is rounded, coarsely."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from noise_model.compiled.arrays import Float64, Integers
from noise_model.instrument.sensor import Sensor

BLOCK_PX = 8

BEST_QUALITY = 100.0
"""Here nothing is rounded: no compression."""

STEPS_AT_50 = np.array(
    [
        [16, 11, 10, 16, 24, 40, 51, 61],
        [12, 12, 14, 19, 26, 58, 60, 55],
        [14, 13, 16, 24, 40, 57, 69, 56],
        [14, 17, 22, 29, 51, 87, 80, 62],
        [18, 22, 37, 56, 68, 109, 103, 77],
        [24, 35, 55, 64, 81, 104, 113, 92],
        [49, 64, 78, 87, 103, 121, 120, 101],
        [72, 92, 95, 98, 112, 100, 103, 99],
    ],
    dtype=np.float64,
)
"""The steps of luminance, DN of 8 bits, at a quality of 50 (ITU-T T.81, table K.1)."""

STEPS_WITHIN = 8
"""Number of steps to either side that are summed for a coefficient's noise after rounding."""

OFF_STEP, SIGMA_STEP = 0.02, 0.01
"""Steps of the table of what rounding leaves: of the value's distance from a whole number, and of sigma."""


def quantisation_steps(quality: float) -> Float64:
    """Return the steps (8, 8), DN of 8 bits, of a quality from 1 to 100: libjpeg's scale, not rounded.

    Below 50 it is 50 / quality, from there 2 - quality / 50; 0 at 100.
    """
    return STEPS_AT_50 * (50.0 / quality if quality < 50.0 else 2.0 - quality / 50.0)


def block_transform(image_dn: Float64) -> Float64:
    """Return the orthonormal cosine transform (h, w, 8, 8) of an image's whole blocks, from its corner."""
    height, width = (size - size % BLOCK_PX for size in image_dn.shape)
    blocks = image_dn[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
    return np.asarray(dctn(blocks.swapaxes(1, 2), axes=(2, 3), norm="ortho"))


def compressed(image_dn: Integers, sensor: Sensor, quality: float) -> Integers:
    """Return a frame (H, W) after JPEG of a quality, DN, in the sensor's type.

    Each block's transform is rounded to whole steps about the middle of the codes. The rim is continued to
    whole blocks. A sensor of more than 8 bits has steps that are as much larger.
    """
    if quality >= BEST_QUALITY:
        return image_dn
    middle = 0.5 * (sensor.max_dn + 1)
    rim = [(0, -size % BLOCK_PX) for size in image_dn.shape]
    coefficients = block_transform(np.pad(image_dn, rim, mode="edge").astype(np.float64) - middle)
    steps = np.maximum(quantisation_steps(quality) * _codes_per_8_bit_code(sensor), 1e-9)
    blocks = idctn(np.rint(coefficients / steps) * steps, axes=(2, 3), norm="ortho") + middle
    rows, columns = blocks.shape[:2]
    whole = blocks.swapaxes(1, 2).reshape(rows * BLOCK_PX, columns * BLOCK_PX)
    codes = np.clip(np.rint(whole[: image_dn.shape[0], : image_dn.shape[1]]), 0, sensor.max_dn)
    return np.asarray(codes.astype(sensor.dtype))


def compressed_variance(mean_dn: Float64, variance_dn2: Float64, sensor: Sensor, quality: float) -> Float64:
    """Return the variance (...,), DN^2, of pixels of a mean and an independent noise that are compressed.

    Of a coefficient c with noise n of the block's variance rounding to steps q leaves E (q round((c + n) / q)
    - c)^2: nothing of n where c is 0 and n far below q, n^2 + q^2 / 12 where it is far above. What a pixel is
    rounded to leaves 1/12 at least. Of pixels that are no frame (H, W) all but the mean
    count as 0.
    """
    if quality >= BEST_QUALITY:
        return variance_dn2
    steps = np.maximum(quantisation_steps(quality) * _codes_per_8_bit_code(sensor), 1e-9)
    if mean_dn.ndim != 2:
        sigma = np.sqrt(variance_dn2)[..., np.newaxis]
        of_steps = steps.ravel()
        after = of_steps[1:] ** 2 * _left_by_rounding(np.zeros(1), sigma / of_steps[1:])
        total = after.sum(axis=-1) + variance_dn2 + of_steps[0] ** 2 / 12.0
        return np.asarray(np.maximum(total / BLOCK_PX**2, 1.0 / 12.0))
    rim = [(0, -size % BLOCK_PX) for size in mean_dn.shape]
    shares = block_transform(np.pad(mean_dn, rim, mode="edge") - 0.5 * (sensor.max_dn + 1)) / steps
    of_blocks = block_transform(np.pad(variance_dn2, rim, mode="edge"))[..., :1, :1] / BLOCK_PX
    after = steps**2 * _left_by_rounding(shares, np.sqrt(of_blocks) / steps)
    ratio = after.mean(axis=(2, 3)) / of_blocks[..., 0, 0]
    # What rounding adds spreads over the block; what it takes away it takes of each pixel's own noise.
    kept, added = np.minimum(ratio, 1.0), np.maximum(ratio - 1.0, 0.0) * of_blocks[..., 0, 0]
    kept_of, added_to = (
        np.kron(of_block, np.ones((BLOCK_PX, BLOCK_PX)))[: mean_dn.shape[0], : mean_dn.shape[1]]
        for of_block in (kept, added)
    )
    return np.asarray(np.maximum(kept_of * variance_dn2 + added_to, 1.0 / 12.0))


def _left_by_rounding(value: Float64, sigma: Float64) -> Float64:
    """Return E (round(value + sigma n) - value)^2 (...,), n normal; 1/12 more than sigma^2 from 1 on."""
    off = np.abs(value - np.rint(value))
    place = np.broadcast_arrays(off / OFF_STEP, np.minimum(sigma, 1.0) / SIGMA_STEP)
    within = map_coordinates(_rounding_table(), np.array(place), order=1, mode="nearest")
    return np.where(sigma < 1.0, within, sigma**2 + 1.0 / 12.0)


@cache
def _rounding_table() -> Float64:
    """Return E (round(value + sigma n) - value)^2 for values 0 to 1/2 and sigmas 0 to 1, in even steps."""
    value = np.arange(0.0, 0.5 + OFF_STEP / 2.0, OFF_STEP)[:, np.newaxis, np.newaxis]
    sigma = np.arange(0.0, 1.0 + SIGMA_STEP / 2.0, SIGMA_STEP)[:, np.newaxis]
    m = np.arange(-STEPS_WITHIN, STEPS_WITHIN + 1)
    spread = np.maximum(sigma, 1e-9)
    in_step = ndtr((m + 0.5 - value) / spread) - ndtr((m - 0.5 - value) / spread)
    return np.asarray(np.sum((m - value) ** 2 * in_step, axis=-1))


def _codes_per_8_bit_code(sensor: Sensor) -> float:
    return (sensor.max_dn + 1) / 256.0

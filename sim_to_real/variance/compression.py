"""Compression that shows in a frame's own codes: its blocks' cosine transforms lie at whole steps.

A frame that was JPEG before it was stored without loss keeps the steps (Fan and de Queiroz 2003, IEEE Trans.
Image Process. 12, 230): a coefficient lies within what rounding to whole DN leaves about a multiple of its
step, where any other's remainder is even. No prediction of the frame is needed. Blocks are taken to start in
the upper left corner: a picture that was cut anywhere else does not show them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from noise_model.compiled.arrays import Float64, Int64, Integers
from noise_model.effects import REGISTRY
from noise_model.effects.compression import BLOCK_PX, block_transform, quantisation_steps
from noise_model.instrument.sensor import Sensor, saturation_dn

QUALITIES = np.arange(1.0, 99.75, 0.25)
"""The qualities that are tried."""

ROUNDED_SIGMA = math.sqrt(1.0 / 12.0)
"""1 sigma of a coefficient, DN, whose pixels are rounded to whole DN."""

MIN_STEP, MAX_STEP = 4.0 * ROUNDED_SIGMA, 20.0
"""A finer step shows in nothing; over a coarser one a scene's own coefficients are not spread evenly."""


@dataclass(frozen=True)
class Compression:
    """The quality that fits the codes best, its 1 sigma, and the evidence that there is any, nats."""

    evidence: float
    quality: float
    sigma: float


def find_compression(images_dn: Sequence[Integers], sensor: Sensor) -> Compression | None:
    """Return the compression that frames (H, W), DN, show; None if they have too little structure.

    Sensors of more than 8 bits are stored in no JPEG: None.
    """
    if sensor.bits > 8:
        return None
    # Number of frames, spread over the recording.
    some = [images_dn[n] for n in np.unique(np.linspace(0, len(images_dn) - 1, 4).astype(int))]
    value, place = _coefficients(some, sensor)
    if len(value) < 200:
        return None
    gains = np.array([_gain(value, place, float(quality)) for quality in QUALITIES])
    (prior,) = REGISTRY["image_compression"].parameters
    ln_prior = -0.5 * ((QUALITIES - prior.start) / prior.prior_sigma) ** 2
    joint = gains + ln_prior - logsumexp(ln_prior)
    weight = np.exp(joint - logsumexp(joint))
    quality = float(weight @ QUALITIES)
    spread = math.sqrt(float(weight @ (QUALITIES - quality) ** 2))
    return Compression(float(logsumexp(joint)), quality, max(spread, float(QUALITIES[1] - QUALITIES[0])))


def _coefficients(images_dn: Sequence[Integers], sensor: Sensor) -> tuple[Float64, Int64]:
    """Return coefficients (n,) of unsaturated blocks, DN, and their places in the block; not the means.

    What is near zero is near a multiple of any step, and is left out.
    """
    values, places = [], []
    for image_dn in images_dn:
        blocks = block_transform(image_dn.astype(np.float64)).reshape(-1, BLOCK_PX**2)
        height, width = (size - size % BLOCK_PX for size in image_dn.shape)
        clipped = image_dn[:height, :width] >= saturation_dn(sensor)
        of_block = clipped.reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX).any(axis=(1, 3))
        free = blocks[~of_block.ravel(), 1:]
        block, place = np.nonzero(np.abs(free) > 0.5 * MIN_STEP)
        values.append(free[block, place])
        places.append(place + 1)
    value, of_block_place = np.concatenate(values), np.concatenate(places)
    # Largest number of coefficients.
    every = max(1, math.ceil(len(value) / 16_000))
    return value[::every], of_block_place[::every]


def _gain(value: Float64, place: Int64, quality: float) -> float:
    """Return ln likelihood of coefficients (n,) at whole steps of a quality, over that of them anywhere."""
    exact = quantisation_steps(quality).ravel()[place]
    # Files have whole steps; the model's have not.
    return max(_gain_of_steps(value, place, step) for step in (np.maximum(np.rint(exact), 1.0), exact))


def _gain_of_steps(value: Float64, place: Int64, step: Float64) -> float:
    tells = (step > MIN_STEP) & (step < MAX_STEP) & (np.abs(value) > 0.5 * step)
    q, v = step[tells], value[tells]
    multiple = np.rint(v / q)
    near = np.exp(-0.5 * ((v - q * multiple) / ROUNDED_SIGMA) ** 2)
    near /= math.sqrt(2.0 * math.pi) * ROUNDED_SIGMA
    # Pixels cut at black or white put a tenth of the coefficients anywhere.
    anywhere = 0.1
    gain = np.log((1.0 - anywhere) * near * q + anywhere)
    _, cell = np.unique(1000 * place[tells] + multiple.astype(np.int64), return_inverse=True)
    count, total = np.bincount(cell), np.bincount(cell, gain)
    # A stripe repeats its coefficients: equal ones count as 4 at most.
    return float(np.sum(total * np.minimum(1.0, 4.0 / np.maximum(count, 1))))

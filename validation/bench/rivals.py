"""Further readers of a stripe from the literature, and all methods of the table with their settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import cv2
import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from validation.bench.methods import Arctrack, FromStripe, Method, PatchTracker, StripeReader
from validation.bench.stripe_peers import PEERS

SCALE = {"steger": 2.0, "sato": 1.4, "centroid": 0.7, "gravity": 2.0, "template": 1.0}
"""The width that each reader is told, over the stripe's sigma: tuned on other scenes, see `tune`."""

SCALES = (0.5, 0.7, 1.0, 1.4, 2.0)
"""What is tried for it."""

ANGLES_DEG = (-60.0, -45.0, -30.0, -15.0, 0.0, 15.0, 30.0, 45.0, 60.0)
"""Directions of the templates."""


def gravity(image: Integers, width_px: float) -> Float64:
    """Return the grey centroid of each column's brightest run over an adaptive threshold.

    The threshold is 2 sigmas over the mean of a window about the pixel: the usual grey-gravity method of
    welding sensors.
    """
    grey = image.astype(np.float32)
    side = 2 * math.ceil(5.0 * width_px) + 1
    mean = cv2.boxFilter(grey, -1, (side, side))
    square = cv2.boxFilter(grey * grey, -1, (side, side))
    over = np.maximum(grey - mean - 2.0 * np.sqrt(np.maximum(square - mean * mean, 0.0)), 0.0)
    over[over < 1.0] = 0.0
    rows = np.arange(len(grey))[:, np.newaxis]
    # A column's brightest run: what is near the largest sum over the stripe's width.
    length = 2 * math.ceil(width_px) + 1
    top = np.argmax(cv2.boxFilter(over, -1, (1, length), normalize=False), axis=0)
    near = np.where(np.abs(rows - top) <= math.ceil(3.0 * width_px), over, 0.0).astype(np.float64)
    total = near.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 0.0, (near * rows).sum(axis=0) / total, np.nan)


def template(image: Integers, width_px: float) -> Float64:
    """Return each column's largest response to templates of a stripe in several directions.

    A stripe's direction by templates: Zeng, Wang, Lu and Kong 2019, J. Image and Graphics 24(10), doi
    10.11834/jig.180609. The largest response is refined by a parabola.
    """
    grey = image.astype(np.float32)
    response = np.max([cv2.filter2D(grey, -1, _template(width_px, angle)) for angle in ANGLES_DEG], axis=0)
    row = np.clip(np.argmax(response, axis=0), 1, image.shape[0] - 2)
    columns = np.arange(image.shape[1])
    above, peak, below = (response[row + step, columns].astype(np.float64) for step in (-1, 0, 1))
    curve = above - 2.0 * peak + below
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = 0.5 * (above - below) / curve
    return np.where((peak > 0.0) & (np.abs(shift) <= 1.0), row + shift, np.nan)


def _template(width_px: float, angle_deg: float) -> Float64:
    """Return a stripe's profile, mean removed, along a direction: a kernel of OpenCV."""
    reach = math.ceil(4.0 * width_px)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    angle = math.radians(angle_deg)
    across = y * math.cos(angle) - x * math.sin(angle)
    along = x * math.cos(angle) + y * math.sin(angle)
    bell = np.exp(-0.5 * (across / width_px) ** 2) * np.exp(-0.5 * (along / (2.0 * width_px)) ** 2)
    envelope = np.exp(-0.5 * (np.hypot(x, y) / (2.0 * width_px)) ** 2)
    kernel = bell - envelope * bell.sum() / envelope.sum()
    return np.asarray(kernel / np.abs(kernel).sum())


READERS: Mapping[str, StripeReader] = {**PEERS, "gravity": gravity, "template": template}
"""All readers of a stripe without what is learned."""


def scaled(name: str, scale: float | None = None) -> StripeReader:
    """Return a reader that is told a share of the stripe's sigma: its own, or another."""
    return partial(_read_scaled, READERS[name], SCALE[name] if scale is None else scale)


def _read_scaled(reader: StripeReader, scale: float, image: Integers, width_px: float) -> Float64:
    return reader(image, scale * width_px)


def _unet() -> Method:
    from validation.bench.unet import UNetReader

    return FromStripe(UNetReader())


METHODS: Mapping[str, Callable[[], Method]] = {
    "arctrack": Arctrack,
    "arctrack, no arc map": partial(Arctrack, use_arc_map=False),
    **{name: partial(FromStripe, scaled(name)) for name in READERS},
    "u-net": _unet,
    "correlation, Kalman": partial(PatchTracker, kernelised=False),
    "KCF, Kalman": partial(PatchTracker, kernelised=True),
}
"""What the table has, by name."""

NEEDS_TORCH = ("u-net",)

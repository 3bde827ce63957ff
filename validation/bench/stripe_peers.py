"""What others read a stripe with, a function each of an image (H, W) and the stripe's sigma in px.

Each returns the stripe's row in every column (W,), NaN where it finds none.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from skimage.filters import sato

from noise_model.compiled.arrays import Float64, Integers


def steger(image: Integers, width_px: float) -> Float64:
    """Return each column's strongest line point (Steger 1998, IEEE TPAMI 20(2) 113): OpenCV, vectorised.

    Derivatives by Gaussian kernels of sigma = width / sqrt(3), along the Hessian's eigenvector of the largest
    curvature the intensity's second-order expansion peaks within half a pixel.
    """
    sigma = max(width_px / math.sqrt(3.0), 1.0)
    grey = image.astype(np.float32)
    x = np.arange(-math.ceil(4.0 * sigma), math.ceil(4.0 * sigma) + 1)
    g = np.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
    # OpenCV correlates: an odd kernel is its own mirror image but for the sign.
    g1, g2 = x / sigma**2 * g, (x**2 / sigma**4 - 1.0 / sigma**2) * g
    r_u, r_v = (cv2.sepFilter2D(grey, cv2.CV_32F, *k) for k in ((g1, g), (g, g1)))
    r_uu, r_uv, r_vv = (cv2.sepFilter2D(grey, cv2.CV_32F, *k) for k in ((g2, g), (g1, g1), (g, g2)))
    half, mean = 0.5 * (r_uu - r_vv), 0.5 * (r_uu + r_vv)
    curvature = mean - np.sqrt(half**2 + r_uv**2)
    n_u, n_v = r_uv, curvature - r_uu
    flat = np.abs(n_u) + np.abs(n_v) < 1e-12
    n_u, n_v = np.where(flat, 0.0, n_u), np.where(flat, 1.0, n_v)
    norm = np.hypot(n_u, n_v)
    n_u, n_v = n_u / norm, n_v / norm
    across = r_uu * n_u**2 + 2.0 * r_uv * n_u * n_v + r_vv * n_v**2
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -(r_u * n_u + r_v * n_v) / across
    is_line = (across < 0.0) & (np.abs(t * n_u) <= 0.6) & (np.abs(t * n_v) <= 0.6)
    strength = np.where(is_line, -across, -np.inf)
    row = np.argmax(strength, axis=0)
    there = row, np.arange(image.shape[1])
    t, n_u, n_v = t[there], n_u[there], n_v[there]
    # The line runs on through the column: its row there.
    shift = t * n_v + t * n_u * n_u / np.where(n_v == 0.0, 1.0, n_v)
    return np.where(np.isfinite(strength[there]), row + shift, np.nan)


def centroid(image: Integers, width_px: float) -> Float64:
    """Return each column's grey centroid about its brightest smoothed pixel, less the darker rim's level."""
    grey = image.astype(np.float32)
    smooth = cv2.GaussianBlur(grey, (1, 2 * math.ceil(width_px) + 1), 0)
    top = np.argmax(smooth, axis=0)
    reach = math.ceil(2.5 * width_px)
    rows = np.clip(top[None, :] + np.arange(-reach, reach + 1)[:, None], 0, image.shape[0] - 1)
    values = grey[rows, np.arange(image.shape[1])[None, :]].astype(np.float64)
    weight = np.maximum(values - values.min(axis=0), 0.0)
    with np.errstate(invalid="ignore"):
        return np.asarray((weight * rows).sum(axis=0) / weight.sum(axis=0))


def ridge(image: Integers, width_px: float) -> Float64:
    """Return the maximum of scikit-image's `sato` ridge filter in each column, refined by a parabola."""
    response = sato(image.astype(np.float64), sigmas=[width_px], black_ridges=False)  # type: ignore[no-untyped-call]
    row = np.clip(np.argmax(response, axis=0), 1, image.shape[0] - 2)
    columns = np.arange(image.shape[1])
    below, peak, above = (response[row + step, columns] for step in (-1, 0, 1))
    curve = below - 2.0 * peak + above
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = 0.5 * (below - above) / curve
    return np.where((peak > 0.0) & (np.abs(shift) <= 1.0), row + shift, np.nan)


PEERS: dict[str, Callable[[Integers, float], Float64]] = {
    "steger": steger,
    "sato": ridge,
    "centroid": centroid,
}

"""Bright and dark lines of an image that stand out on both of their sides.

The mean along a short line is compared with those along two parallels, one on either side,

    bright = L - max(L_left, L_right),    dark = min(L_left, L_right) - L,

the brighter side being the one that counts (Tupin, Maitre, Mangin, Nicolas and Pechersky 1998, IEEE Trans.
Geosci. Remote Sens. 36, 434). A slope, an edge of a face and that of a shadow are no line: one side is as
bright. What noise alone makes of either is no larger than the difference of two such means.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from noise_model.compiled.arrays import Float32

N_ANGLES = 8
"""Directions that are tried, evenly over half a turn."""

LENGTH_PX, SPACING_PX = 5, 3
"""Length of a line, and distance of the parallels next to it, pixels of the image."""

BLUR_PX = 0.65
"""1 sigma of a line's blur: an oblique line without blur would break into beads."""


@dataclass(frozen=True, eq=False)
class LineResponse:
    """Responses (N_ANGLES, h, w), in the image's unit, of lines about each pixel."""

    bright: Float32
    dark: Float32


def line_kernels() -> Float32:
    """Return the mean along a line, with a Gaussian's blur, as kernels (N_ANGLES, k, k)."""
    reach = LENGTH_PX // 2 + math.ceil(3.0 * BLUR_PX)
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    angle = (math.pi * np.arange(N_ANGLES) / N_ANGLES)[:, np.newaxis, np.newaxis]
    along = column * np.cos(angle) + row * np.sin(angle)
    across = row * np.cos(angle) - column * np.sin(angle)
    box = ndtr((along + 0.5 * LENGTH_PX) / BLUR_PX) - ndtr((along - 0.5 * LENGTH_PX) / BLUR_PX)
    kernels = box * np.exp(-0.5 * (across / BLUR_PX) ** 2)
    return np.asarray(kernels / kernels.sum(axis=(1, 2), keepdims=True), dtype=np.float32)


KERNELS = line_kernels()
"""Means along a line in every direction (N_ANGLES, k, k)."""

NOISE_GAIN = float(np.sqrt(2.0 * np.max(np.sum(KERNELS**2, axis=(1, 2)))))
"""1 sigma of the difference of two lines' means, over that of a pixel."""


def line_response(image: Float32) -> LineResponse:
    """Return the line responses of an image (h, w); -inf where a parallel lies beyond the rim."""
    h, w = image.shape
    bright = np.full((N_ANGLES, h, w), -np.inf, dtype=np.float32)
    dark = bright.copy()
    for n, kernel in enumerate(KERNELS):
        mean = np.asarray(
            cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32
        )
        angle = math.pi * n / N_ANGLES
        x, y = round(-SPACING_PX * math.sin(angle)), round(SPACING_PX * math.cos(angle))
        rows, columns = slice(abs(y), h - abs(y)), slice(abs(x), w - abs(x))
        line, one_side, other_side = (
            mean[abs(y) + by * y : h - abs(y) + by * y, abs(x) + by * x : w - abs(x) + by * x]
            for by in (0, 1, -1)
        )
        bright[n, rows, columns] = line - np.maximum(one_side, other_side)
        dark[n, rows, columns] = np.minimum(one_side, other_side) - line
    return LineResponse(bright, dark)

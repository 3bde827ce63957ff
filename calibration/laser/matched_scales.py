"""Light smoothed along and across a bright line, for lines of several widths."""

from collections.abc import Iterator

import cv2
import numpy as np

from noise_model.compiled.arrays import Float32

SCALES_PX = (1.5, 3.0, 6.0, 12.0)
"""The sigmas of the lines that are looked for."""


def smoothed_by_scale(lines: Float32) -> Iterator[tuple[float, Float32, Float32]]:
    """Yield each sigma that scan lines (n, m) have room for, with the light about a line and that around."""
    for sigma in SCALES_PX:
        # The surroundings are averaged with 2.5 times the line's sigma.
        around = 2.5
        if 2.0 * around * sigma < lines.shape[1]:
            near, wide = (
                np.asarray(cv2.GaussianBlur(lines, (0, 0), sigmaX=across, sigmaY=1.0), np.float32)
                for across in (sigma, around * sigma)
            )
            yield sigma, near, wide

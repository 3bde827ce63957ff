"""Frames of a speckled stripe that stands still, drawn pixel by pixel without the estimator's code."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter


@dataclass(frozen=True)
class DrawnStripe:
    """A sensor, a stripe and its speckle."""

    gain: float = 12.0
    black: float = 9.0
    read: float = 14.0
    contrast: float = 0.3
    grain: float = 1.2
    power_rel: float = 0.01
    shift_px: float = 0.02
    peak_e: float = 900.0
    shape: tuple[int, int] = (240, 96)

    def frames(self, count: int, draw: np.random.Generator) -> list[npt.NDArray[np.uint8]]:
        """Return 8-bit frames (H, W) of one scene."""
        y, x = np.mgrid[0 : self.shape[0], 0 : self.shape[1]].astype(float)
        field = gaussian_filter(draw.standard_normal(self.shape), self.grain, mode="wrap")
        spread = math.sqrt(math.log1p(self.contrast**2))
        speckle = np.exp(spread * field * 2.0 * math.sqrt(math.pi) * self.grain - 0.5 * spread**2)
        taken = []
        for _ in range(count):
            centre = 48.0 + 4.0 * np.sin(y / 90.0) + self.shift_px * draw.standard_normal()
            light = self.peak_e * np.exp(-0.5 * ((x - centre) / 4.0) ** 2) * speckle
            charge = draw.poisson(light * (1.0 + self.power_rel * draw.standard_normal()))
            charge = charge + draw.normal(0.0, self.read, self.shape)
            taken.append(np.clip(np.rint(self.black + charge / self.gain), 0, 255).astype(np.uint8))
        return taken

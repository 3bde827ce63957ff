"""Flat and dark frames of a sensor, drawn pixel by pixel without the estimator's code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class DrawnSensor:
    """A sensor to find: what it turns charge into."""

    bits: int = 10
    gain: float = 20.0
    black: float = 40.0
    read: float = 18.0
    well: float = 16000.0
    gamma: float = 1.0
    dsnu: float = 5.0
    prnu: float = 0.01
    shading: float = 0.04

    def pair(
        self, light_e: float, draw: np.random.Generator, side: int = 96, second: float = 1.0
    ) -> list[Image]:
        """Return two frames of a mean light, e-, the second of which may be brighter."""
        chip = np.random.default_rng(7)
        own, offset = chip.standard_normal((side, side)), chip.standard_normal((side, side))
        y, x = np.mgrid[-1.0 : 1.0 : side * 1j, -1.0 : 1.0 : side * 1j]
        light = (1.0 - self.shading * (x**2 + y**2)) * (1.0 + self.prnu * own)
        frames = []
        for factor in (1.0, second):
            charge = draw.poisson(factor * light_e * light) + self.dsnu * offset
            charge = np.minimum(charge + draw.normal(0.0, self.read, charge.shape), self.well)
            share = np.abs(charge) / self.well
            dn = self.black + self.well / self.gain * np.sign(charge) * share**self.gamma
            frames.append(np.clip(np.rint(dn), 0, 2**self.bits - 1).astype(np.uint16))
        return frames

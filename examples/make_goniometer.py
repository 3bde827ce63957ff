"""Make the goniometer examples: python examples/make_goniometer.py, anywhere; the same seed, the same files.

Both materials of Table 1 that do not mirror and a white standard under one source and camera, at a gamma of
0.45 and a black level of 10 DN: 20 readings a setting, 0.2 s apart, noise 0.8 DN and 1 % of the signal.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from arctrack.calibrate.reflectance.goniometer import write_goniometer
from calibration.goniometer import GreyResponse, Settings, simulate
from calibration.reading_noise import ReadingNoise
from noise_model.surface.brdf import MILD_STEEL, ZN_COATED, Material

SEED = 20030201
REPEATS = 20
ALBEDO = 0.99
RESPONSE = GreyResponse(gamma=0.45, black_dn=10.0, saturation_dn=255.0)
NOISE = ReadingNoise(additive_dn=0.8, relative=0.01)
SAMPLE_SETTINGS = Settings.in_plane([20.0, 40.0, 60.0], np.arange(0.0, 76.0, 5.0))
WHITE_SETTINGS = Settings.in_plane([20.0, 40.0, 60.0], [0.0])
SCALE = 0.75
"""The light of a unit f_r under a unit irradiance: the brightest reading stays below saturation."""


def main(folder: Path = Path(__file__).parent) -> None:
    """Write goniometer_{mild_steel,zn_coated,white}.csv into a folder."""
    rng = np.random.default_rng(SEED)
    white = Material("white", ALBEDO / math.pi, 0.0, 1.0)
    for material, settings in (
        (MILD_STEEL, SAMPLE_SETTINGS),
        (ZN_COATED, SAMPLE_SETTINGS),
        (white, WHITE_SETTINGS),
    ):
        each, gray_level = simulate(settings, material, SCALE, RESPONSE, NOISE, REPEATS, rng)
        write_goniometer(folder / f"goniometer_{material.name}.csv", each, gray_level)


if __name__ == "__main__":
    main()

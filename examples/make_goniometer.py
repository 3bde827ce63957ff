"""Make the goniometer examples: python examples/make_goniometer.py, anywhere; the same seed, the same files.

Both materials of Table 1 that do not mirror and a white standard under one source and camera, at a gamma of
0.45 and a black level of 10 DN: 20 readings a setting, 0.2 s apart, noise 0.8 DN and 1 % of the signal.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from arctrack.calibrate.reflectance.goniometer import NEEDED, TIME
from calibration.goniometer import GreyResponse, Settings
from calibration.reading_noise import ReadingNoise
from noise_model.compiled.arrays import Float64
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

READING_INTERVAL_S = 0.2
"""The paper's interval between the 20 readings of a setting."""


def simulate(
    settings: Settings,
    material: Material,
    scale: float,
    response: GreyResponse,
    noise: ReadingNoise,
    repeats: int,
    rng: np.random.Generator,
) -> tuple[Settings, Float64]:
    """Return settings and whole grey levels (N,), `repeats` times each setting in turn, with their noise."""
    each = settings.subset(np.repeat(np.arange(len(settings)), repeats))
    level = response.gray_level(scale * each.light(material))
    noisy = level + rng.normal(size=len(each)) * np.sqrt(noise.variance(level - response.black_dn))
    return each, np.clip(np.rint(noisy), 0.0, response.saturation_dn)


def write_goniometer(path: Path, settings: Settings, gray_level: Float64) -> None:
    """Write readings (N,), taken `READING_INTERVAL_S` apart, under a source at one distance."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([TIME, *NEEDED])
        columns = (settings.theta_i_deg, settings.theta_r_deg, settings.phi_r_deg, gray_level)
        for n, row in enumerate(zip(*columns, strict=True)):
            writer.writerow([f"{n * READING_INTERVAL_S:.1f}", *(f"{value:g}" for value in row)])


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

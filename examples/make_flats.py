"""Make flat and dark frames to calibrate a sensor with: python examples/make_flats.py FOLDER.

The sensor is the example's, but for a gain, a read noise and a black level of its own: 75 e-/DN, 52 e- and
6.5 DN. Its pixels differ by 8 e- in the dark and by 0.9 % under light. The same seed makes the same files.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from noise_model.instrument.sensor import Sensor, respond

SEED = 1288
SENSOR = Sensor(bits=8, gain_e_per_dn=75.0, black_level_dn=6.5, read_noise_e=52.0, full_well_e=17_500.0)
DSNU_E, PRNU = 8.0, 0.009
EXPOSURES_MS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 25.0)
LIGHT_E_PER_MS, SHADING = 1500.0, 0.05
LIGHT_ERROR = 1e-3
"""By how much an exposure's light is off, 1 sigma, relative."""

SHAPE = (160, 200)


def main(folder: Path, sensor: Sensor = SENSOR) -> None:
    """Write two frames of each exposure, and two dark ones, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(SEED)
    dark_e, response = DSNU_E * rng.standard_normal(SHAPE), 1.0 + PRNU * rng.standard_normal(SHAPE)
    y, x = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in SHAPE), indexing="ij")
    light = LIGHT_E_PER_MS * (1.0 - SHADING * (x**2 + y**2)) * response
    for name, exposure_ms in (("dark", 0.0), *(("flat", ms) for ms in EXPOSURES_MS)):
        level = exposure_ms * (1.0 + LIGHT_ERROR * rng.standard_normal())
        for n in (1, 2):
            charge = (
                rng.poisson(max(level, 0.0) * light) + dark_e + rng.normal(0.0, sensor.read_noise_e, SHAPE)
            )
            dn = np.clip(np.rint(respond(charge, sensor)), 0.0, sensor.max_dn)
            stated_ms = exposure_ms or EXPOSURES_MS[0]
            cv2.imwrite(str(folder / f"{name}_{stated_ms:g}ms_{n}.png"), dn.astype(np.uint8))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    main(parser.parse_args().folder)

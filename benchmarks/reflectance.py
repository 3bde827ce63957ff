"""How well goniometer readings return a base metal's reflectance, and how often its 95 % intervals hold it.

python benchmarks/reflectance.py [--draws 2000] [--seed 1]

Each draw simulates readings at 48 settings in the plane of incidence (theta_i 20, 40, 60 deg; theta_r 0 to 75
deg), of a white standard at three, with noise of 0.8 DN and 1 % of the signal, rounded to whole grey levels,
and fits them. `bias` is the mean error in sigmas, `covered` the share of draws whose interval holds it;
by chance alone it strays 0.5 % (1 sigma) at 2000 draws.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.goniometer import GreyResponse, Readings, Settings, average
from calibration.reading_noise import ReadingNoise
from calibration.reflectance import Reflectance, identify_reflectance
from calibration.reflectance_model import NAMES, White
from noise_model.surface.brdf import MILD_STEEL, ZN_COATED, Material

sys.path.append(str(Path(__file__).parents[1] / "examples"))

from make_goniometer import simulate

SAMPLE = Settings.in_plane([20.0, 40.0, 60.0], np.arange(0.0, 76.0, 5.0))
STANDARD = Settings.in_plane([20.0, 40.0, 60.0], [0.0])
ALBEDO = 0.99
WHITE = Material("white", ALBEDO / math.pi, 0.0, 1.0)
NOISE = ReadingNoise(additive_dn=0.8, relative=0.01)
BRIGHTEST = 0.88


@dataclass(frozen=True)
class Case:
    """What is drawn again and again."""

    material: Material
    gamma: float
    repeats: int
    absolute: bool


CASES = [
    Case(material, gamma, repeats, absolute)
    for material in (MILD_STEEL, ZN_COATED)
    for gamma, repeats in ((1.0, 20), (0.45, 20), (1.0, 1))
    for absolute in (True, False)
]


def draw(case: Case, rng: np.random.Generator) -> Reflectance:
    response = GreyResponse(case.gamma, black_dn=10.0, saturation_dn=255.0)
    scale = BRIGHTEST ** (1.0 / case.gamma) / max(
        SAMPLE.light(case.material).max(), STANDARD.light(WHITE).max()
    )

    def read(settings: Settings, material: Material) -> Readings:
        return average(*simulate(settings, material, scale, response, NOISE, case.repeats, rng))

    sample, standard = read(SAMPLE, case.material), read(STANDARD, WHITE)
    total = case.material.kappa_diff + case.material.kappa_spec
    white = White(standard, ALBEDO) if case.absolute else None
    return identify_reflectance(sample, response, white=white, total=total)


def measure(case: Case, draws: int, seed: int) -> list[str]:
    rng = np.random.default_rng([seed, CASES.index(case)])
    truth = np.array([case.material.kappa_diff, case.material.kappa_spec, case.material.c2])
    results = [draw(case, rng) for _ in range(draws)]
    values, sigmas = np.array([r.values for r in results]), np.array([r.sigmas for r in results])
    low, high = np.moveaxis(np.array([r.intervals for r in results]), 2, 0)
    covered = ((low <= truth) & (truth <= high)).mean(axis=0)
    bias = ((values - truth) / sigmas).mean(axis=0)
    by = "white" if case.absolute else "total"
    return [
        f"{case.material.name:<11} {case.gamma:5g} {case.repeats:7d}  {by:<5}  {name:<10} {truth[i]:8g} "
        f"{np.median(values[:, i]):9.5g} {100 * np.median(sigmas[:, i]) / truth[i]:7.2f} % {bias[i]:+6.2f} "
        f"{100 * covered[i]:7.2f} %"
        for i, name in enumerate(NAMES)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    start = time.perf_counter()
    print("material    gamma repeats  scale  parameter     truth    median   sigma    bias   covered")
    with ProcessPoolExecutor(max_workers=2) as pool:
        waiting = [pool.submit(measure, case, options.draws, options.seed) for case in CASES]
        for future in waiting:
            print("\n".join(future.result()), flush=True)
    print(f"{options.draws} draws each, seed {options.seed}, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()

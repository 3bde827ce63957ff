"""Judge a fan and its thickness as boards tell them: calibrate_laser_fan.py [--worlds N] [--seed S]

A fan of 3 to 30 deg to either side ends on 4 to 12 boards at depths that span 10 to 40 % of their distance.
The ends scatter by 0.02 to 0.3 mm; one in ten sets has a wrong one. The sheet's thickness goes as the setup's
model has it, or as a beam about its waist; boards tell it to 0.5 to 3 %. Bounds are those of least squares
with the scatter known.
"""

from __future__ import annotations

import math

import numpy as np
from calibration_tally import Tally, judge_worlds
from scipy.stats import norm

from calibration.laser.fan import Fan, fit_fan
from calibration.laser.width import Law, fit_width

HALF = float(norm.isf(0.025))


def judge_fan(rng: np.random.Generator, tally: Tally) -> bool:
    """Draw a fan and find it; return whether the ends were refused."""
    half, turn = math.radians(rng.uniform(3.0, 30.0)), math.radians(rng.uniform(-5.0, 5.0))
    apex = rng.normal(0.0, 5.0, 2)
    distance, span = rng.uniform(100.0, 400.0), rng.uniform(0.1, 0.4)
    sigma = float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
    slopes, sides, variances = np.tan([turn - half, turn + half]), [], []
    for k in slopes:
        depth = apex[0] + distance * (1.0 + span * rng.uniform(-0.5, 0.5, int(rng.integers(4, 13))))
        across = apex[1] + k * (depth - apex[0])
        A = np.column_stack([np.ones(len(depth)), depth - apex[0]])
        variances.append(sigma**2 * np.linalg.inv(A.T @ A))
        noise = sigma * rng.standard_normal(len(depth))
        sides.append(np.column_stack([depth, across + noise]))
    if rng.random() < 0.1 and len(sides[0]) > 5:
        sides[0][2, 1] += 20.0 * sigma
    fan = fit_fan(sides, 0.01)
    if not isinstance(fan, Fan):
        return True
    opening = slopes[1] - slopes[0]
    # The sides' levels at the apex move it along the axis; their slopes change the angle.
    along = math.sqrt(variances[0][0, 0] + variances[1][0, 0]) / abs(opening)
    bend = [
        math.degrees(0.5 * math.sqrt(V[1, 1]) / (1.0 + k * k)) for V, k in zip(variances, slopes, strict=True)
    ]
    for name, value, true, n, bound in (
        ("origin's height", fan.apex[0], apex[0], 0, along),
        ("half angle", fan.half_angle_deg, math.degrees(half), 2, math.hypot(*bend)),
    ):
        error, width = float(value - true), float(fan.sigma[n])
        tally.add(name, error, width, abs(error) <= HALF * width, bound)
    return False


def judge_width(rng: np.random.Generator, tally: Tally, laws: list[bool]) -> None:
    """Draw a sheet's thickness on boards, and find it at tool height."""
    height, count = rng.uniform(100.0, 300.0), int(rng.integers(5, 13))
    depth = height * (1.0 + rng.uniform(0.1, 0.4) * np.linspace(-0.5, 0.5, count))
    is_waist = rng.random() < 0.5
    if is_waist:
        waist, at, reach = (
            rng.uniform(0.05, 0.2),
            height * rng.uniform(0.9, 1.1),
            height * rng.uniform(0.05, 0.15),
        )

        def true(z: float | np.ndarray) -> np.ndarray:
            return np.asarray(waist * np.sqrt(1.0 + ((z - at) / reach) ** 2))
    else:
        sigma = rng.uniform(0.1, 0.5)

        def true(z: float | np.ndarray) -> np.ndarray:
            return np.asarray(sigma * z / height)

    error = rng.uniform(0.005, 0.03) * true(depth)
    seen = true(depth) + error * rng.standard_normal(count)
    pairs = {float(z): (float(s), float(e)) for z, s, e in zip(depth, seen, error, strict=True)}
    width = fit_width(pairs, height)
    assert width is not None
    laws.append((width.law is Law.WAIST) == is_waist)
    if width.at_height_mm is None:
        return
    value, within = width.at_height_mm
    off = value - float(true(height))
    bound = None if is_waist else 1.0 / math.sqrt(float(np.sum((depth / height / error) ** 2)))
    name = "thickness, beam" if is_waist else "thickness, model"
    tally.add(name, off, within, abs(off) <= HALF * within, bound)


def judge(worlds: int, seed: int) -> None:
    """Judge so many fans and sheets."""
    tally, laws, refused = Tally(), [], 0
    for n in range(worlds):
        rng = np.random.default_rng([seed, n])
        refused += judge_fan(rng, tally)
        judge_width(rng, tally, laws)
    tally.report()
    print(f"{refused} of {worlds} fans are refused; the law is right in {100.0 * np.mean(laws):.1f} %")


if __name__ == "__main__":
    judge_worlds(judge, __doc__)

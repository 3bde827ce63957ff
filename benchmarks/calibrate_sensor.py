"""The sensor's calibration on random sensors of known truth: bias, coverage, and error over the least
possible.

    python benchmarks/calibrate_sensor.py [--worlds WORLDS] [--seed SEED]

Each world has a sensor, a light and exposures of its own, drawn here pixel by pixel without any code of the
estimator. The least possible error is Cramer and Rao's, of closed formulas for normal pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from calibration_tally import Tally, judge_worlds
from scipy.special import gamma as gamma_function

from calibration.sensor.flat_fields import calibrate_sensor
from calibration.sensor.levels import level_from

SIDES_PX = (160, 256)


@dataclass(frozen=True)
class World:
    """A sensor and what it is shown."""

    bits: int
    gain: float
    black: float
    read: float
    well: float
    gamma: float
    dsnu: float
    prnu: float
    brightness: float
    light_error: float
    shading: float
    exposures: tuple[float, ...]
    saturated: float
    side: int

    @property
    def top(self) -> float:
        """The code at which it saturates."""
        return float(min(round(self.black + self.well / self.gain), 2**self.bits - 1))

    @property
    def truth(self) -> dict[str, float]:
        """The values that a calibration is to find; gain and full well are those at the top code."""
        swing = self.top - self.black
        full = self.well * (swing * self.gain / self.well) ** (1.0 / self.gamma)
        return {
            "gain_e_per_dn": full / swing,
            "black_level_dn": self.black,
            "read_noise_e": self.read,
            "full_well_e": full,
            "gamma": self.gamma,
            "dsnu_e": self.dsnu,
            "prnu_rel": self.prnu,
        }


def draw_world(draw: np.random.Generator) -> World:
    """Draw a sensor, a light and its exposures."""
    bits = int(draw.choice([8, 10, 12]))
    gamma = 1.0 if draw.random() < 0.5 else float(draw.uniform(0.4, 0.9))
    well = float(np.exp(draw.uniform(np.log(5e3), np.log(60e3))))
    black = float(draw.uniform(0.02, 0.08)) * 2**bits
    reach = float(draw.uniform(0.85, 1.3))
    gain = well / ((2**bits - 1 - black) * reach)
    full = well * min(1.0, 1.0 / reach) ** (1.0 / gamma)
    exposures = np.geomspace(1.0, float(draw.uniform(8.0, 25.0)), int(draw.integers(8, 15)))
    bright = float(draw.uniform(0.7, 0.9)) * full / exposures[-1]
    least = 0.6 * gain if gamma == 1.0 else 0.0
    return World(
        bits=bits,
        gain=gain,
        black=black,
        read=max(float(draw.uniform(3.0, 25.0)), least),
        well=well,
        gamma=gamma,
        dsnu=float(draw.uniform(1.0, 6.0)),
        prnu=float(draw.uniform(0.003, 0.02)),
        brightness=bright,
        light_error=float(np.exp(draw.uniform(np.log(3e-4), np.log(5e-3)))),
        shading=float(draw.uniform(0.0, 0.08)),
        exposures=tuple(exposures),
        saturated=float(draw.uniform(2.0, 4.0)) * full / bright,
        side=int(draw.choice(SIDES_PX)),
    )


def frames(world: World, draw: np.random.Generator) -> list[tuple[float, bool, list[np.ndarray]]]:
    """Return exposure, whether lit, and two frames, of darks, flats, and one saturated level."""
    shape = (world.side, world.side)
    own, offset = draw.standard_normal(shape), draw.standard_normal(shape)
    y, x = np.mgrid[-1.0 : 1.0 : world.side * 1j, -1.0 : 1.0 : world.side * 1j]
    falloff = 1.0 - world.shading * (x**2 + y**2)
    light = falloff / falloff.mean() * (1.0 + world.prnu * own)
    taken = []
    for exposure, is_lit in [(1.0, False), *((e, True) for e in (*world.exposures, world.saturated))]:
        level = exposure * world.brightness * math.exp(world.light_error * draw.standard_normal()) * is_lit
        pair = []
        for _ in range(2):
            charge = draw.poisson(level * light) + world.dsnu * offset
            charge = np.minimum(charge + draw.normal(0.0, world.read, shape), world.well)
            share = np.abs(charge) / world.well
            dn = world.black + world.well / world.gain * np.sign(charge) * share**world.gamma
            pair.append(np.clip(np.rint(dn), 0, 2**world.bits - 1).astype(np.uint16))
        taken.append((exposure, is_lit, pair))
    return taken


def min_sigmas(world: World) -> dict[str, float]:
    """Return Cramer and Rao's bound, 1 sigma, of normal pixels by closed formulas."""
    truth, n = world.truth, (world.side - 10) ** 2
    light = np.array([0.0, *(e * world.brightness for e in world.exposures)])
    names = list(truth)

    def moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        gain, black, read, gamma, dsnu, prnu = x[:6]
        charge = np.concatenate([[0.0], np.exp(x[6:])])
        swing = world.top - black
        full = gain * swing
        noise = np.maximum(charge, 0.0) + read**2
        safe = np.maximum(charge, 1e-9)
        slope = np.where(charge > 0.0, swing / full * gamma * (safe / full) ** (gamma - 1.0), 0.0)
        all_dark = read**2 + dsnu**2
        absolute = 2.0**gamma * gamma_function(gamma + 0.5) / math.sqrt(math.pi)
        slope[0] = math.sqrt(absolute * swing**2 * full ** (-2.0 * gamma) * all_dark ** (gamma - 1.0))
        variance = slope**2 * noise + 1.0 / 12.0
        mean = black + swing * (charge / full) ** gamma
        pattern = np.outer(slope, slope) * (dsnu**2 + prnu**2 * np.outer(charge, charge))
        return mean, variance, pattern + np.diag(variance / 2.0)

    x = np.array([*(truth[k] for k in names if k != "full_well_e"), *np.log(light[1:])])
    steps = 1e-5 * np.abs(x) + 1e-9
    slopes = []
    for k in range(len(x)):
        low, high = (moments(x + sign * steps * (np.arange(len(x)) == k)) for sign in (-1, 1))
        slopes.append([(b - a) / (2.0 * steps[k]) for a, b in zip(low, high, strict=True)])
    _, variance, Sigma = moments(x)
    J_mean, J_variance = (np.stack([slope[i] for slope in slopes]) for i in (0, 1))
    information = (
        J_mean / (variance / (2.0 * n)) @ J_mean.T + J_variance / (2.0 * variance**2 / n) @ J_variance.T
    )
    whitened = np.stack([np.linalg.solve(Sigma, slope[2]) for slope in slopes])
    information += 0.5 * n * np.einsum("kij,lji->kl", whitened, whitened)
    levels = len(world.exposures)
    information[6:, 6:] += (np.eye(levels) - 1.0 / levels) / world.light_error**2
    covariance = np.linalg.inv(information)
    sigma = dict(zip([k for k in names if k != "full_well_e"], np.sqrt(np.diag(covariance)[:6]), strict=True))
    swing = world.top - world.black
    row = np.zeros(len(x))
    row[0], row[1] = swing, -truth["gain_e_per_dn"]
    sigma["full_well_e"] = math.sqrt(row @ covariance @ row)
    # The patterns of so many pixels are a sample: their mean is a part of the black level.
    sigma["black_level_dn"] = math.hypot(
        sigma["black_level_dn"], world.dsnu / truth["gain_e_per_dn"] / (world.side - 10)
    )
    return sigma


def judge(worlds: int, seed: int) -> None:
    """Print bias, coverage and error over the bound of each parameter."""
    tally = Tally()
    refused: list[str] = []
    chi2, linear = [], []
    for number in range(worlds):
        draw = np.random.default_rng([seed, number])
        world = draw_world(draw)
        try:
            levels = [
                level_from(pair, 1e-3 * t, is_lit, world.bits) for t, is_lit, pair in frames(world, draw)
            ]
            result = calibrate_sensor(levels, world.bits)
        except ValueError as error:
            refused.append(f"world {number}: {error}")
            continue
        bound = min_sigmas(world)
        chi2.append(result.chi2)
        line = result["linearity_rel"]
        linear.append(((line.value / world.light_error) ** 2, line.low <= world.light_error <= line.high))
        for name, true in world.truth.items():
            estimate = result[name]
            is_inside = estimate.low <= true <= estimate.high
            tally.add(name, estimate.value - true, estimate.sigma, is_inside, bound[name])
    tally.report()
    squares, hit = np.array(linear).T
    print(
        f"linearity_rel    its square over the true one {np.mean(squares):.2f} ± "
        f"{np.std(squares) / math.sqrt(len(squares)):.2f}  covered {100.0 * np.mean(hit):5.1f} %"
    )
    print(f"{len(chi2)} worlds calibrated, {len(refused)} refused; chi2 per freedom {np.mean(chi2):.2f}")
    for reason in refused:
        print(reason)


if __name__ == "__main__":
    judge_worlds(judge, __doc__)

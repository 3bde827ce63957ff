"""The sensor's calibration from a still stripe, on random stripes of known truth: bias, coverage, error.

    python benchmarks/calibrate_still.py [--worlds WORLDS] [--seed SEED]

Each world has a sensor, a stripe, its speckle and a laser of its own, drawn here pixel by pixel without any
code of the estimator. The least possible error of gain and read noise is Cramer and Rao's for normal pixels
of known means, beside a shake and a flicker that are fitted along.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from calibration_tally import Tally, judge_worlds
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from calibration.sensor.still import calibrate_still
from noise_model.instrument.sensor import Sensor

FINER = 3
"""So many times finer than the pixels the speckle is drawn."""


@dataclass(frozen=True)
class World:
    """A sensor, a stripe and its speckle."""

    bits: int
    gain: float
    black: float
    read: float
    contrast: float
    grain: float
    stripe_px: float
    peak: float
    power_rel: float
    shake_px: float
    frames: int
    shape: tuple[int, int]

    @property
    def truth(self) -> dict[str, float]:
        """What a calibration is to find."""
        return {
            "gain_e_per_dn": self.gain,
            "black_level_dn": self.black,
            "read_noise_e": self.read,
            "contrast": self.contrast,
            "grain_px": self.grain,
        }


def draw_world(draw: np.random.Generator) -> World:
    """Draw a sensor, a stripe and a laser."""
    bits = int(draw.choice([8, 10, 12]))
    gain = float(np.exp(draw.uniform(np.log(8.0), np.log(60.0)))) * 2.0 ** (8 - bits)
    return World(
        bits=bits,
        gain=gain,
        black=float(draw.uniform(0.03, 0.08)) * 2**bits,
        # Noise of half a code and more: less is rounding's.
        read=gain * float(draw.uniform(0.6, 2.0)) * (2.0 ** (bits - 8)) ** 0.5,
        contrast=float(draw.uniform(0.1, 0.4)),
        grain=float(draw.uniform(0.7, 1.8)),
        stripe_px=float(draw.uniform(3.0, 9.0)),
        peak=float(draw.uniform(0.2, 0.35)),
        power_rel=float(draw.uniform(0.0, 0.02)),
        shake_px=float(draw.uniform(0.0, 0.04)),
        frames=int(draw.integers(20, 50)),
        shape=(int(draw.integers(240, 480)), 128),
    )


def frames(world: World, draw: np.random.Generator) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the frames, and the light (H, W), e-, of a still one."""
    height, width = world.shape
    y, x = np.mgrid[0:height, 0:width].astype(float)
    # Finer than the pixels: a sampled Gaussian a pixel wide has another correlation.
    fine = tuple(FINER * n for n in world.shape)
    field = gaussian_filter(draw.standard_normal(fine), FINER * world.grain, mode="wrap")[::FINER, ::FINER]
    field *= 2.0 * math.sqrt(math.pi) * FINER * world.grain
    spread = math.sqrt(math.log1p(world.contrast**2))
    speckle = np.exp(spread * field - 0.5 * spread**2)
    top = 2**world.bits - 1
    peak = world.peak * world.gain * (top - world.black)
    centre = 0.5 * width + 6.0 * np.sin(y / 180.0 + draw.uniform(0.0, 6.0)) + draw.uniform(-3.0, 3.0)

    def light(shift: float) -> np.ndarray:
        return np.asarray(peak * np.exp(-0.5 * ((x - centre - shift) / world.stripe_px) ** 2) * speckle)

    taken = []
    for _ in range(world.frames):
        power = 1.0 + world.power_rel * draw.standard_normal()
        charge = draw.poisson(power * light(world.shake_px * draw.standard_normal()))
        charge = charge + draw.normal(0.0, world.read, world.shape)
        dn = np.clip(np.rint(world.black + charge / world.gain), 0, top)
        taken.append(dn.astype(np.uint8 if world.bits == 8 else np.uint16))
    return taken, light(0.0)


def min_sigmas(world: World, light: np.ndarray) -> dict[str, float]:
    """Return Cramer and Rao's bounds, 1 sigma, of gain and read noise."""
    seen = light.ravel() / world.gain
    down, across = np.gradient(light / world.gain)
    top = 2**world.bits - 1
    usable = seen + world.black + 4.0 * np.sqrt(seen / world.gain + (world.read / world.gain) ** 2) < top
    shapes = np.stack([seen, np.ones_like(seen), (down**2 + across**2).ravel(), seen**2])[:, usable]
    variance = shapes[0] / world.gain + (world.read / world.gain) ** 2 + 1.0 / 12.0
    scaled = shapes / variance
    C = np.linalg.inv(scaled @ scaled.T * 0.5 * (world.frames - 1))
    J = np.array([[-(world.gain**2), 0.0], [-world.read * world.gain, 0.5 * world.gain**2 / world.read]])
    sigma = np.sqrt(np.diag(J @ C[:2, :2] @ J.T))
    return {"gain_e_per_dn": float(sigma[0]), "read_noise_e": float(sigma[1])}


def judge(worlds: int, seed: int) -> None:
    """Print bias, coverage and error over the bound of each value."""
    tally = Tally()
    refused = []
    for number in range(worlds):
        draw = np.random.default_rng([seed, number])
        world = draw_world(draw)
        images, light = frames(world, draw)
        stated = Sensor(world.bits, 1.3 * world.gain, world.black + 1.0, 0.7 * world.read, 1e9)
        try:
            result = calibrate_still(images, stated)
        except ValueError as error:
            refused.append(f"world {number}: {error}")
            continue
        pairs = {name: (e.value, e.sigma) for name, e in result.estimates.items()}
        half = dict.fromkeys(pairs, norm.isf(0.025))
        if result.speckle is not None:
            pairs["contrast"] = result.speckle.contrast, result.speckle.contrast_sigma
            pairs["grain_px"] = result.speckle.grain_px, result.speckle.grain_sigma_px
            half |= dict.fromkeys(("contrast", "grain_px"), result.speckle.half_width)
        bound = min_sigmas(world, light)
        for name, (value, sigma) in pairs.items():
            error = value - world.truth[name]
            tally.add(name, error, sigma, abs(error) < half[name] * sigma, bound.get(name))
    tally.report()
    print(f"{len(refused)} refused")
    for reason in refused:
        print(reason)


if __name__ == "__main__":
    judge_worlds(judge, __doc__)

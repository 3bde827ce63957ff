"""Frames whose noise, pattern, grains and streaks are known, made without the forward model.

Smooth light, a stripe across, and a camera that travels with the tool; 80 x 60 bins of 4 x 4 pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
from scipy.ndimage import gaussian_filter

from noise_model.condition import Condition
from sim_to_real.data.binned import STRATA, ObservedFrame, ObservedRecording, binned_camera
from sim_to_real.data.blocks import block_means
from sim_to_real.fit.frame_light import FrameLight
from sim_to_real.variance.haar_details import VarianceSizes
from tests.noise_model.scenes import camera, setup

BIN_PX, WIDTH, HEIGHT = 4, 320, 240
SENSOR = setup("flat").sensor
STRIPE_ROW, STRIPE_PX, STRIPE_E = 70.0, 7.0, 5000.0
TRAVEL_MM = 0.8
NO_MORE = VarianceSizes(0.0, 0.0, 0.0, 0.0, np.eye(4), 0.0)


def setup_of():
    return setup("flat", of_camera=camera(width=WIDTH, height=HEIGHT, focal_px=1095.0, psf_sigma_px=0.0))


@dataclass(frozen=True)
class Scattering:
    """What scatters, in parameters of the catalogue; `drawn` (n_frames, H, W), e-, is added to the light."""

    ratio: float = 1.0
    pixels: float = 0.0
    columns: float = 0.0
    contrast: float = 0.0
    grain_px: float = 1.0
    drawn: np.ndarray | None = None


NOTHING = Scattering()


def streak(u, v, angle, length_px, width_px, peak_e):
    """A streak (H, W), e-: Gaussian dots every quarter of a pixel along a line."""
    image, step = np.zeros((HEIGHT, WIDTH)), 0.25
    for t in np.arange(-0.5 * length_px + 0.5 * step, 0.5 * length_px, step):
        x, y = u + t * math.cos(angle), v + t * math.sin(angle)
        rows, columns = (
            np.arange(max(0, int(place - 5.0 * width_px)), min(most, max(0, int(place + 5.0 * width_px))))
            for place, most in ((y, HEIGHT), (x, WIDTH))
        )
        across, down = (
            np.exp(-0.5 * ((n - place) / width_px) ** 2) for n, place in ((columns, x), (rows, y))
        )
        image[np.ix_(rows, columns)] += np.outer(down, across)
    return image * peak_e * step / (math.sqrt(2.0 * math.pi) * width_px)


def light_e(n, with_stripe=True):
    """Arc and laser (H, W), e-, of a frame: of six one is dark, one laser alone, two arc alone, two both."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    kind = n % 6
    arc = 1500.0 + 6000.0 * np.exp(-((column - 150.0 - 3.0 * n) ** 2 + (row - 260.0) ** 2) / 120.0**2)
    stripe = STRIPE_E * np.exp(-0.5 * ((row - STRIPE_ROW) / STRIPE_PX) ** 2)
    return (arc if kind > 1 else 0.0 * arc), (stripe if kind in (1, 4, 5) and with_stripe else 0.0 * stripe)


def recorded(rng, scattering=NOTHING, n_frames=18, with_stripe=True):
    """A recording, and what a fit would say of it: stand-ins for `Expected` and `Refit`."""
    nominal = setup_of()
    pattern = scattering.pixels * rng.standard_normal((HEIGHT, WIDTH))
    pattern = pattern + scattering.columns * rng.standard_normal(WIDTH)
    frames, passed = [], []
    for n in range(n_frames):
        arc, laser = light_e(n, with_stripe)
        charge = arc + laser * grains(rng, scattering)
        if scattering.drawn is not None:
            charge = charge + scattering.drawn[n]
        charge = rng.poisson(np.maximum(charge * (1.0 + pattern), 0.0))
        charge = charge + rng.normal(0.0, scattering.ratio * SENSOR.read_noise_e, charge.shape)
        charge = np.minimum(charge, SENSOR.full_well_e) / SENSOR.gain_e_per_dn
        image = np.clip(np.rint(charge + SENSOR.black_level_dn), 0, 255).astype(np.uint8)
        frames.append(observed_frame(n, image, arc, laser))
        passed.append(as_passed(nominal, frames[-1], arc, laser))
    binned = replace(nominal, camera=binned_camera(nominal.camera, BIN_PX))
    observed = ObservedRecording(nominal, binned, BIN_PX, None, None, tuple(frames))
    return SimpleNamespace(observed=observed), SimpleNamespace(lights=tuple(passed))


def grains(rng, scattering):
    if scattering.contrast == 0.0:
        return 1.0
    field = gaussian_filter(rng.standard_normal((HEIGHT, WIDTH)), scattering.grain_px, mode="wrap")
    return 1.0 + scattering.contrast * field / field.std()


def observed_frame(n, image, arc, laser):
    binned_dn = block_means(image, BIN_PX).astype(np.float32)
    keep = np.zeros(binned_dn.shape, dtype=bool)
    keep[::2, ::2] = True
    in_stripe = block_means(laser, BIN_PX) > 0.02 * STRIPE_E
    keep |= in_stripe
    T_base_tool = np.eye(4)
    T_base_tool[:3, 3] = TRAVEL_MM * n, 3.0 * math.sin(n), 0.0
    return ObservedFrame(
        n,
        n,
        0.1 * n,
        STRATA[int(laser.any()) + 2 * int(arc.any())],
        Condition(float(laser.any()), float(arc.any()), setup_of().camera.exposure_s, 0.1 * n),
        lambda t: T_base_tool,
        (0.0, 1.0, 0.0),
        image,
        binned_dn,
        keep,
        keep,
        np.full(int(keep.sum()), 0.5),
        in_stripe[keep],
        block_means(arc + laser, BIN_PX).astype(np.float32),
        block_means(arc, BIN_PX).astype(np.float32),
        np.zeros(int(keep.sum())),
    )


def as_passed(nominal, frame, arc, laser):
    arc_e, laser_e = (block_means(light, BIN_PX)[frame.keep].astype(np.float32) for light in (arc, laser))
    item = np.ones_like(arc_e)
    return FrameLight(nominal.sensor, arc_e, laser_e, np.zeros_like(arc_e), item, item, np.zeros_like(arc_e))

"""Is the arc's light what a setup expects: its level in each frame, and its shape over the image.

Pixels of a lattice, off the stripe, off saturation and off the edges of the joint's faces, are compared with
the arc map at the seam that the stripes show. In each frame

    charge = level (map + spread <map>) + black,

<map> the map's mean over the frame: what lies evenly over the image is light that optics scatter. What is
left of a pixel, relative to the light there, is the error of the map's shape. Between stripe and torch the
seam may wander: what that makes of each quantity is part of its sigma.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from calibration.arc.lattice import choose_pixels
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64, Int64
from noise_model.fit import Parameter, fit
from noise_model.instrument.camera import Rays
from noise_model.robust import sigma_of
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import transform
from tracker.arc.level import HUBER
from tracker.geometry import SensorGeometry
from tracker.state import Frame

SHAPE_SIGMA = 0.02
"""1 sigma of the map's error from pixel to pixel, relative, with all within its tolerance."""

MIN_PIXELS = 40
"""Least number of pixels of a frame."""

MAX_NOISE = 0.03
"""The shape is judged where a block's noise is a smaller share of the light."""


@dataclass(frozen=True)
class ValueWithSigma:
    """A value and its 1 sigma; NaN where the frames do not determine it."""

    value: float
    sigma: float


@dataclass(frozen=True, eq=False)
class ArcFrame:
    """A frame's arc light at the pixels (n,) that are compared.

    `uv_px` (n, 2) are their places, `charge_e` what they hold, `noise_e` its 1 sigma, `map_e` the light that
    the setup expects. `level` is the arc's output over the expected one, and `off` (n,) how far the charge
    lies off the fit, relative to the light there.
    """

    frame: Frame
    uv_px: Int64
    charge_e: Float64
    noise_e: Float64
    map_e: Float64
    level: float
    off: Float64


@dataclass(frozen=True, eq=False)
class ArcLightCheck:
    """Comparison of the arc's light with the expected one, over all frames.

    `level` is the median output over the expected one, `unsteady` its relative scatter from frame to frame.
    `exposure_power` and `current_power` are its exponents of exposure and current beyond the expected.
    `shape` is the map's relative error, robust RMS without noise; `spread` the share of a frame's light that
    is uniform over it. Sigmas include the fit's own and that of an unknown seam at the torch.
    """

    frames: tuple[ArcFrame, ...]
    level: ValueWithSigma
    unsteady: ValueWithSigma
    exposure_power: ValueWithSigma
    current_power: ValueWithSigma
    shape: ValueWithSigma
    spread: ValueWithSigma


def compare_arc(setup: Setup, frames: Sequence[tuple[Frame, Float64]], seam: SeamLine) -> ArcLightCheck:
    """Compare the arc's light in frames, each with T_base_tool (4, 4), with what a setup expects at a seam.

    Raises ValueError if the setup states no arc or no metal, and where no frame shows enough of its light.
    """
    setup.require("the check of the arc's light", "arc", "material")
    geometry = SensorGeometry.of(setup)
    rays = Rays.of(geometry.setup.camera)
    here = _compare(geometry, rays, frames, seam)
    torch_mm = float(np.median([_torch_mm(geometry.setup, T_base_tool) for _, T_base_tool in frames]))
    away_mm = torch_mm - seam.station_mm
    # At the torch the seam may lie 1 mm sideways and 0.3 mm in height off the stripes' line, 1 sigma.
    others = [
        _compare(geometry, rays, frames, seam._replace(slope_y=seam.slope_y + 1.0 / away_mm)),
        _compare(geometry, rays, frames, seam._replace(slope_z=seam.slope_z + 0.3 / away_mm)),
    ]

    def with_wander(name: str) -> ValueWithSigma:
        known: ValueWithSigma = getattr(here, name)
        changes = [getattr(other, name).value - known.value for other in others]
        return ValueWithSigma(known.value, math.hypot(known.sigma, *changes))

    return ArcLightCheck(here.frames, *(with_wander(value.name) for value in fields(here)[1:]))


def _torch_mm(true: Setup, T_base_tool: Float64) -> float:
    """Return the torch's station, mm."""
    return float(transform(make_scene(true, T_base_tool).T_joint_tool, np.zeros(3))[0])


def _compare(
    geometry: SensorGeometry, rays: Rays, frames: Sequence[tuple[Frame, Float64]], seam: SeamLine
) -> ArcLightCheck:
    seen = [_select_pixels(geometry, rays, frame, T_base_tool, seam) for frame, T_base_tool in frames]
    seen = [frame for frame in seen if len(frame.charge_e) >= MIN_PIXELS]
    if not seen:
        raise ValueError("no frame shows the arc's light below saturation, off the stripe and off edges")
    return _fit_levels(geometry.setup, seen)


def _select_pixels(
    geometry: SensorGeometry, rays: Rays, frame: Frame, T_base_tool: Float64, seam: SeamLine
) -> ArcFrame:
    """Return a frame's pixels that count; level and `off` are not known yet."""
    seen = choose_pixels(geometry, rays, frame, T_base_tool, seam)
    return ArcFrame(frame, seen.uv_px, seen.charge_e, seen.noise_e, seen.map_e, math.nan, np.empty(0))


def _fit_levels(true: Setup, seen: Sequence[ArcFrame]) -> ArcLightCheck:
    """Fit the frames' levels, the black level's offset and the share that is spread."""
    n = len(seen)
    starts = [max(float(np.median(f.charge_e / f.map_e)), 1e-3) for f in seen]
    black_e = max(true.tolerance.black_level_dn * true.sensor.gain_e_per_dn, 1e-3)
    parameters = [
        *(Parameter(f"ln_level_{i}", "", math.log(start)) for i, start in enumerate(starts)),
        Parameter("black", "e-", 0.0, black_e, step=0.01 * black_e),
        Parameter("spread", "", 0.0),
    ]

    def off_e(x: Float64, i: int) -> Float64:
        mean_e = math.exp(x[i]) * (seen[i].map_e + x[n + 1] * seen[i].map_e.mean()) + x[n]
        return np.asarray(seen[i].charge_e - mean_e)

    def residuals(x: Float64) -> Float64:
        parts = [
            off_e(x, i) / np.hypot(f.noise_e, SHAPE_SIGMA * start * f.map_e)
            for i, (f, start) in enumerate(zip(seen, starts, strict=True))
        ]
        return np.concatenate(parts)

    result = fit(parameters, residuals, huber=HUBER)
    x, sigmas = result.values, result.sigmas * math.sqrt(max(result.chi2, 1.0))
    levels = np.exp(x[:n])
    frames = tuple(
        replace(f, level=float(level), off=off_e(x, i) / (level * f.map_e))
        for i, (f, level) in enumerate(zip(seen, levels, strict=True))
    )
    level = float(np.median(levels))
    exposure_power, current_power, scatter = _powers([f.frame for f in seen], x[:n], sigmas[:n])
    return ArcLightCheck(
        frames,
        ValueWithSigma(level, level * float(np.median(sigmas[:n]))),
        scatter,
        exposure_power,
        current_power,
        _shape(frames),
        ValueWithSigma(float(x[n + 1]), float(sigmas[n + 1])),
    )


def _shape(frames: Sequence[ArcFrame]) -> ValueWithSigma:
    """Return the map's relative error, RMS by a robust measure, the noise taken off."""
    off = np.concatenate([f.off for f in frames])
    noise = np.concatenate([f.noise_e / (f.level * f.map_e) for f in frames])
    bright = noise < MAX_NOISE
    if bright.sum() < MIN_PIXELS:
        return ValueWithSigma(math.nan, math.nan)
    rms = sigma_of(off[bright])
    noise_rms = float(np.sqrt(np.mean(noise[bright] ** 2)))
    return ValueWithSigma(math.sqrt(max(rms**2 - noise_rms**2, 0.0)), rms / math.sqrt(2.0 * bright.sum()))


def _powers(
    frames: Sequence[Frame], ln_levels: Float64, sigmas: Float64
) -> tuple[ValueWithSigma, ValueWithSigma, ValueWithSigma]:
    """Return with which powers of exposure and current levels (n,) go, and their scatter beyond that."""
    ln = np.log([[frame.exposure_s, frame.current_a] for frame in frames])
    # Differences below 10 % are scatter.
    varies = np.isfinite(ln).all(axis=0) & (np.ptp(ln, axis=0) > 0.1)
    columns = [np.ones(len(frames)), *(ln[:, k] - ln[:, k].mean() for k in np.flatnonzero(varies))]
    A = np.column_stack(columns)
    freedom = len(frames) - A.shape[1]
    known = [ValueWithSigma(math.nan, math.nan)] * 2
    if freedom < 1 or np.linalg.matrix_rank(A) < A.shape[1]:
        return known[0], known[1], ValueWithSigma(math.nan, math.nan)
    x, *_ = np.linalg.lstsq(A, ln_levels, rcond=None)
    scatter = float(np.sqrt(np.sum((ln_levels - A @ x) ** 2) / freedom))
    size = math.hypot(scatter, float(np.median(sigmas)))
    x_sigmas = size * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    for place, k in enumerate(np.flatnonzero(varies), start=1):
        known[k] = ValueWithSigma(float(x[place]), float(x_sigmas[place]))
    return known[0], known[1], ValueWithSigma(scatter, size / math.sqrt(2.0 * freedom))

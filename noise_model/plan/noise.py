"""Expected uncertainty of the seam in one pose: each scan line's bound, and all together."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.sensor import Sensor, linearise, saturation_dn, variance_e2
from noise_model.instrument.spectrum import ArcSpectrum, Filter, FilterCurve
from noise_model.plan.cramer_rao import (
    AMPLITUDE,
    POSITION,
    pixel_contrast,
    sampled_edge_sigma_mm,
    seam_covariance_mm2,
    speckle_image_sigma_mm,
    stripe_sigmas,
)
from noise_model.plan.design import design_of, gains_over_effects, magnification
from noise_model.plan.light import ARC_PLACES, HALF_WINDOW_SIGMAS, SampledStripe
from noise_model.setup import Setup
from noise_model.setup_keys import DIMENSIONS
from noise_model.stripe import stripe_depth_mm
from noise_model.surface.joint import Joint, section

NODES = 33
"""Nodes across a scan line's window: a quarter of the stripe's sigma apart, as good as an integral."""

MIN_LINES = 5.0
"""Least number of readable scan lines on either side of the seam."""

EDGE_LINES = 0.1
"""No upright edge is placed better, in scan lines: it is rounded and has burrs. It is the tracker's floor."""

MIN_NORMAL_Z = 1e-6
"""A face whose normal has less than this of z is upright."""

IN_PLANE_MM = 1e-6
"""Distance from an upright side's plane below which a point lies in it."""

_T = np.linspace(-HALF_WINDOW_SIGMAS, HALF_WINDOW_SIGMAS, NODES)
_PLACES = np.linspace(-HALF_WINDOW_SIGMAS, HALF_WINDOW_SIGMAS, ARC_PLACES)
_TO_NODES = np.array([np.interp(_T, _PLACES, unit) for unit in np.eye(ARC_PLACES)])


@dataclass(frozen=True)
class Surroundings:
    """Assumptions of a plan in addition to the setup.

    `speckle_contrast` of the laser before the pixels average it, 1 for a coherent one on a rough surface, 0
    to leave the floor out; `spectrum` of the arc.
    """

    speckle_contrast: float = 1.0
    spectrum: ArcSpectrum = field(default_factory=ArcSpectrum)

    def __post_init__(self) -> None:
        if not 0.0 <= self.speckle_contrast <= 1.0:
            raise ValueError(f"speckle contrast {self.speckle_contrast:g}: must be 0 to 1")


@dataclass(frozen=True, eq=False)
class ExpectedPixels:
    """Expected charge of n rays' pixels at the setup's exposure, e-.

    `stripe_e` (n,) the stripe's peak, `arc_e` (n, NODES) the arc's light across the window.
    """

    stripe_e: Float64
    arc_e: Float64

    @property
    def mean_e(self) -> Float64:
        """Stripe and arc across the window (n, NODES)."""
        return self.stripe_e[:, np.newaxis] * np.exp(-0.5 * _T**2) + self.arc_e


@dataclass(frozen=True, eq=False)
class LineBounds:
    """The rays of a `SampledStripe` as read: per ray (n,).

    `sigma_px` the bound of the stripe's position, NaN where it cannot be read; `readable`; `saturated`;
    `arc_over_stripe` at the stripe's centre, NaN where unseen.
    """

    sigma_px: Float64
    readable: Bool
    saturated: Bool
    arc_over_stripe: Float64


@dataclass(frozen=True)
class SeamNoise:
    """Expected 1 sigma of the seam in one pose: `sigma_y_mm` to the side, `sigma_z_mm` in height.

    `sigma_mm` is the root of their squares' sum; all NaN where the seam is not determined. `sigma_px` is
    the median over the scan lines within reach that can be read and `arc_over_stripe` over those that are
    seen, NaN where there is none; `blind_share` is the share of lines that cannot be read: hidden, out of the
    image, drowned or saturated, the last also alone.
    """

    sigma_y_mm: float
    sigma_z_mm: float
    sigma_px: float
    arc_over_stripe: float
    blind_share: float
    saturated_share: float

    @property
    def sigma_mm(self) -> float:
        """The root of the sum of both squares."""
        return math.hypot(self.sigma_y_mm, self.sigma_z_mm)


BLIND = SeamNoise(math.nan, math.nan, math.nan, math.nan, 1.0, 0.0)


def speckle_floor_px(setup: Setup, contrast: float) -> float:
    """Return the speckle floor of a scan line's position, px, for the lens at the setup's stand-off.

    Dorsch et al. 1994 in the image, `cramer_rao.speckle_image_sigma_mm`, with N' = N (1 + m) of a thin lens
    focused on the plate, and the contrast that a pixel's width along the stripe leaves.
    """
    wavelength_mm, image_f_number, pixel_mm = _speckle_optics(setup, design_of(setup).stand_off_mm)
    remaining = contrast * pixel_contrast(wavelength_mm, image_f_number, pixel_mm)
    return speckle_image_sigma_mm(wavelength_mm, image_f_number, remaining) / pixel_mm


def expected_speckle(setup: Setup) -> dict[str, float]:
    """Return the parameters of `laser_speckle` that laser, lens and pixel make on a rough metal.

    A grain s = lambda / (2 sin u') = lambda N' wide has the intensity's correlation sinc^2(x / s) (Goodman
    2007, sec. 4.6; Dorsch et al. 1994). Metal keeps the polarisation, so the contrast is 1 before the pixel.
    A square pixel p leaves `cramer_rao.pixel_contrast` of it along either axis. The correlation behind it has
    the curvature of a Gaussian exp(-d^2 / 4 g^2), g^2 = 3 s^2 / (4 pi^2) + p^2 / 12.
    """
    wavelength_mm, image_f_number, pixel_mm = _speckle_optics(setup, stripe_depth_mm(setup))
    grain_px = wavelength_mm * image_f_number / pixel_mm
    contrast = pixel_contrast(wavelength_mm, image_f_number, pixel_mm) ** 2
    return {"contrast": contrast, "grain_px": math.sqrt(3.0 * grain_px**2 / (4.0 * math.pi**2) + 1.0 / 12.0)}


def _speckle_optics(setup: Setup, stand_off_mm: float) -> tuple[float, float, float]:
    """Return wavelength, mm, f-number in the image and a pixel's side, mm, of a lens focused on the plate.

    The focal length in pixels is the image's distance f (1 + m) over the pixel.
    """
    camera = setup.camera
    farther = 1.0 + magnification(setup, stand_off_mm)
    pixel_mm = farther * camera.focal_length_mm / math.sqrt(camera.fx * camera.fy)
    return 1e-6 * setup.laser.wavelength_nm, farther * camera.f_number, pixel_mm


def saturation_e(sensor: Sensor) -> float:
    """Return the charge from which on a pixel says no more than 'at least this bright'."""
    return min(sensor.full_well_e, float(linearise(saturation_dn(sensor), sensor)))


def expected_pixels(
    light: SampledStripe, setup: Setup, around: Surroundings, optics: Filter | FilterCurve | None = None
) -> ExpectedPixels:
    """Return the expected pixels of a light behind a filter, the setup's own if none is given."""
    gains = gains_over_effects(setup, optics or setup.stated_filter, around.spectrum, light.theta)
    stripe = np.where(light.seen, light.stripe_e, 0.0) * gains[0]
    return ExpectedPixels(stripe, (light.arc_e * gains[1][:, np.newaxis]) @ _TO_NODES)


def line_bounds(
    light: SampledStripe, pixels: ExpectedPixels, sensor: Sensor, floor_px: float, exposure: float = 1.0
) -> LineBounds:
    """Return how well each ray's scan lines can be read at an exposure over the setup's.

    The noise is that of the expected pixels: shot noise of stripe and arc, read noise, quantisation.
    """
    stripe = pixels.stripe_e * exposure
    mean = exposure * pixels.mean_e
    width = np.where(light.seen, light.width_px, 1.0)
    spacing = width * (_T[1] - _T[0])
    sigmas = stripe_sigmas(width[:, np.newaxis] * _T, stripe, width, variance_e2(mean, sensor), spacing)
    saturated = light.seen & (mean.max(axis=1, initial=0.0) >= saturation_e(sensor))
    with np.errstate(divide="ignore", invalid="ignore"):
        # A stripe fainter than this many of its amplitude's own bounds is not found among false ones.
        detected = stripe > 5.0 * sigmas[:, AMPLITUDE]
        ratio = np.where(light.seen, pixels.arc_e[:, NODES // 2] / pixels.stripe_e, np.nan)
    readable = light.seen & detected & ~saturated
    sigma = np.where(readable, np.hypot(sigmas[:, POSITION], floor_px), np.nan)
    return LineBounds(sigma, readable, saturated, ratio)


def seam_noise(light: SampledStripe, bounds: LineBounds, joint: Joint) -> SeamNoise:
    """Return the seam point's noise from that of the scan lines."""
    lines = float(light.lines.sum())
    if not lines > 0.0:
        return BLIND
    read = bounds.readable
    share = float(light.lines[read].sum()) / lines
    saturated = float(light.lines[bounds.saturated].sum()) / lines
    ratio = float(np.median(bounds.arc_over_stripe[light.seen])) if light.seen.any() else math.nan
    if not read.any():
        return SeamNoise(math.nan, math.nan, math.nan, ratio, 1.0, saturated)
    # The tracker fits no upright side: its edge says where it is.
    level = light.normals[:, 2] > MIN_NORMAL_Z
    y, used = light.points[:, 1], read & level
    sides = [used & (side * y > 0.0) & (np.abs(y) < _half_mouth_mm(joint)) for side in (-1.0, 1.0)]
    sigma_y = sigma_z = math.nan
    if min(float(light.lines[side].sum()) for side in sides) >= MIN_LINES:
        sigma_px = np.where(used, bounds.sigma_px, np.nan)
        edge_sigma_mm = _edge_sigma_mm(light, used, level & ~read, joint)
        covariance = seam_covariance_mm2(light.normals, light.moves, sigma_px, light.lines, edge_sigma_mm)
        sigma_y, sigma_z = (float(v) for v in np.sqrt(np.diagonal(covariance)))
    return SeamNoise(sigma_y, sigma_z, float(np.median(bounds.sigma_px[read])), ratio, 1.0 - share, saturated)


def longest_exposure(brightest_e: float, sensor: Sensor) -> float:
    """Return the longest exposure, over that which gives `brightest_e`, that saturates nothing expected."""
    full = saturation_e(sensor)
    noise = math.sqrt(float(variance_e2(full, sensor)))
    # Distance from saturation of the brightest expected pixel at the longest exposure, in its own noise.
    return max(full - 4.0 * noise, 0.1 * full) / max(brightest_e, 1e-9)


def _half_mouth_mm(joint: Joint) -> float:
    """Return within how far of the seam the joint's own shape lies: a groove's bevels, else anywhere."""
    if "depth_mm" not in DIMENSIONS[joint.type]:
        return math.inf
    return float(section(joint).vertices[-2, 0])


class _Edge(NamedTuple):
    """An upright edge at `y_mm`, `step_mm` high, its lower side at larger y (1) or smaller (-1)."""

    y_mm: float
    step_mm: float
    lower_side: float


def _edge_sigma_mm(light: SampledStripe, read: Bool, unread: Bool, joint: Joint) -> float:
    """Return the sigma of y from a section's upright edges; rays of other sides are `read` or `unread`."""
    vertices = section(joint).vertices
    uprights = [
        _Edge(float(y_mm), abs(float(rise)), -math.copysign(1.0, rise))
        for y_mm, (across, rise) in zip(vertices[:-1, 0], np.diff(vertices, axis=0), strict=True)
        if across == 0.0
    ]
    information = sum(_one_edge_sigma_mm(light, read, unread, edge) ** -2.0 for edge in uprights)
    return information**-0.5 if information > 0.0 else math.inf


def _one_edge_sigma_mm(light: SampledStripe, read: Bool, unread: Bool, edge: _Edge) -> float:
    """Return the sigma of an upright edge's own position.

    It lies between two scan lines, whose shares of either side's stripe determine it. Lines between those
    that are read make that wider: there are no shares then, and it may lie anywhere there. What the edge
    hides can be computed.
    """
    y = light.points[:, 1]
    left, right = read & (y < edge.y_mm), read & (y > edge.y_mm)
    if not (left.any() and right.any()):
        return math.inf
    between = light.seen & unread & (y > y[left].max()) & (y < y[right].min())
    mm_per_line = float(np.median(light.length_mm[read] / light.lines[read]))
    if not between.any():
        upper = left if edge.lower_side > 0.0 else right
        rim_mm = float(light.points[upper][np.argmin(np.abs(y[upper] - edge.y_mm)), 2])
        of_side = sampled_edge_sigma_mm(_seen_side_mm(light, edge, rim_mm))
        return math.hypot(EDGE_LINES * mm_per_line, of_side)
    return sampled_edge_sigma_mm((1.0 + float(light.lines[between].sum())) * mm_per_line)


def _seen_side_mm(light: SampledStripe, edge: _Edge, rim_mm: float) -> float:
    """Return the width of the lower side, mm, that an edge's upright side hides, lit and seen, else 0.

    Its light may count as either side's stripe.
    """
    of_eye, of_source = (edge.lower_side * (float(P[1]) - edge.y_mm) for P in (light.eye, light.source))
    # What stands in the side's own plane, up to rounding, neither lights nor sees it.
    if min(of_eye, of_source) < IN_PLANE_MM:
        return 0.0
    return of_eye / (float(light.eye[2]) - rim_mm) * edge.step_mm

"""The search over sensor designs: each judged by the seam's sigma along the path, and the best of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.plan.design import (
    SensorDesign,
    clears_torch,
    design_of,
    filter_of,
    passes_laser,
    with_design,
)
from noise_model.plan.light import SampledStripe, stripe_level_e, stripe_light
from noise_model.plan.noise import (
    BLIND,
    ExpectedPixels,
    SeamNoise,
    Surroundings,
    expected_pixels,
    line_bounds,
    longest_exposure,
    seam_noise,
    speckle_floor_px,
)
from noise_model.setup import Setup

PERCENTILE = 95.0
"""A design is as good as this percentile of the seam's sigma along the path."""

EQUAL_SIGMA_SHARE = 0.02
"""Sigmas nearer to each other than this share are no reason to prefer one."""

Progress = Callable[[int, int], None]
"""Callback with the number of designs done, and its total."""


@dataclass(frozen=True)
class DesignCandidate:
    """A design and what it shows along the path.

    `sigma_mm`, `sigma_y_mm`, `sigma_z_mm` are 95th percentiles, infinite where more stations than that leave
    the seam unknown; `sigma_px` and `arc_over_stripe` likewise of the stations' medians, NaN where nothing is
    read; `blind_share`, `saturated_share` are means over stations.
    """

    design: SensorDesign
    sigma_mm: float
    sigma_y_mm: float
    sigma_z_mm: float
    sigma_px: float
    arc_over_stripe: float
    blind_share: float
    saturated_share: float


@dataclass(frozen=True)
class SearchSpace:
    """The values to try of each part of a design; the laser's lean stays as it is.

    Designs whose camera would look through the torch, of `torch_radius_mm`, are left out.
    Exposures are not searched: of all that saturate no expected pixel the longest has the least noise, so
    each design takes that one, up to `max_exposure_s`.
    """

    tilts_deg: tuple[float, ...]
    azimuths_deg: tuple[float, ...]
    previews_mm: tuple[float, ...]
    stand_offs_mm: tuple[float, ...]
    filters_nm: tuple[float, ...]
    max_exposure_s: float
    torch_radius_mm: float

    def poses(self, own: SensorDesign) -> list[SensorDesign]:
        """Return every combination but for the filter, the rest as in the user's own design."""
        every = (
            replace(own, tilt_deg=tilt, azimuth_deg=azimuth, preview_mm=preview, stand_off_mm=stand_off)
            for tilt, azimuth, preview, stand_off in itertools.product(
                self.tilts_deg, self.azimuths_deg, self.previews_mm, self.stand_offs_mm
            )
        )
        return [design for design in every if clears_torch(design, self.torch_radius_mm)]


def judge(
    setup: Setup,
    design: SensorDesign,
    poses: Float64,
    around: Surroundings,
    filters_nm: Sequence[float] | None = None,
    max_exposure_s: float | None = None,
) -> list[DesignCandidate]:
    """Judge a design at poses T_base_tool (n, 4, 4), once for each filter, its own if none is given.

    With `max_exposure_s` each takes the longest exposure up to it that saturates nothing expected, else the
    design's own. A pose that the design cannot be used at is blind, and so is a filter that the laser does
    not pass.
    """
    own = design_of(setup)
    filters = [design.filter_fwhm_nm] if filters_nm is None else filters_nm
    try:
        # The geometry is the same behind every filter: light is computed once, behind the setup's own, and
        # for the setup's exposure, which is what the effects state their charges for.
        bare = with_design(
            setup,
            replace(design, filter_fwhm_nm=own.filter_fwhm_nm, exposure_s=own.exposure_s),
            around.spectrum,
        )
        floor_px = speckle_floor_px(bare, around.speckle_contrast)
        level_e = stripe_level_e(bare)
    except ValueError:
        return [summarise(replace(design, filter_fwhm_nm=fwhm), [BLIND]) for fwhm in filters]
    lights = [_light(bare, T_base_tool, level_e) for T_base_tool in poses]
    made = []
    for fwhm in filters:
        if not passes_laser(setup, fwhm):
            made.append(summarise(replace(design, filter_fwhm_nm=fwhm), [BLIND]))
            continue
        optics = filter_of(setup, fwhm)
        pixels = [None if light is None else expected_pixels(light, bare, around, optics) for light in lights]
        exposure_s = design.exposure_s
        if max_exposure_s is not None:
            longest = longest_exposure(_brightest(pixels), bare.sensor)
            exposure_s = min(max_exposure_s, longest * own.exposure_s)
        exposure = exposure_s / own.exposure_s
        noise = [
            BLIND
            if light is None or seen is None
            else seam_noise(light, line_bounds(light, seen, bare.sensor, floor_px, exposure), bare.joint)
            for light, seen in zip(lights, pixels, strict=True)
        ]
        final = replace(design, filter_fwhm_nm=fwhm, exposure_s=exposure_s)
        made.append(summarise(final, noise))
    return made


def summarise(design: SensorDesign, noise: Sequence[SeamNoise]) -> DesignCandidate:
    """Return the summary of a design's stations."""
    columns = {
        name: np.array([getattr(station, name) for station in noise])
        for name in ("sigma_mm", "sigma_y_mm", "sigma_z_mm", "sigma_px", "arc_over_stripe")
    }
    seam = {
        name: float(np.percentile(np.where(np.isnan(values), np.inf, values), PERCENTILE, method="higher"))
        for name, values in columns.items()
        if name.endswith("_mm")
    }
    read = {name: _percentile_of_known(columns[name]) for name in ("sigma_px", "arc_over_stripe")}
    return DesignCandidate(
        design=design,
        **seam,
        **read,
        blind_share=float(np.mean([station.blind_share for station in noise])),
        saturated_share=float(np.mean([station.saturated_share for station in noise])),
    )


def search(
    setup: Setup, space: SearchSpace, poses: Float64, around: Surroundings, progress: Progress | None = None
) -> list[DesignCandidate]:
    """Judge every design of a space."""
    designs = space.poses(design_of(setup))
    judged = []
    for n, design in enumerate(designs):
        judged += judge(setup, design, poses, around, space.filters_nm, space.max_exposure_s)
        if progress is not None:
            progress(n + 1, len(designs))
    return judged


def refine(
    setup: Setup, start: DesignCandidate, space: SearchSpace, poses: Float64, around: Surroundings
) -> DesignCandidate:
    """Look half a step of tilt and azimuth to every side of a design and return the best."""
    tilts, azimuths = (
        [v - 0.5 * step, v, v + 0.5 * step]
        for v, step in (
            (start.design.tilt_deg, _step(space.tilts_deg)),
            (start.design.azimuth_deg, _step(space.azimuths_deg)),
        )
    )
    best = start
    for tilt, azimuth in itertools.product(tilts, azimuths):
        inside = min(space.tilts_deg) <= tilt <= max(space.tilts_deg)
        inside &= min(space.azimuths_deg) <= azimuth <= max(space.azimuths_deg)
        if not inside or (tilt, azimuth) == (start.design.tilt_deg, start.design.azimuth_deg):
            continue
        design = replace(start.design, tilt_deg=tilt, azimuth_deg=azimuth)
        if not clears_torch(design, space.torch_radius_mm):
            continue
        [judged] = judge(setup, design, poses, around, None, space.max_exposure_s)
        best = min(best, judged, key=lambda c: c.sigma_mm)
    return best


def pareto(candidates: Sequence[DesignCandidate]) -> list[DesignCandidate]:
    """Return the designs that no other beats, by rising sigma.

    One beats another that is no worse in all of the seam's sigma, the preview (short: the path errs less
    until the torch is there) and the stand-off (long: less spatter), and better in one; sigmas within
    `EQUAL_SIGMA_SHARE` of each other are the same. Designs that leave the seam unknown are out.
    """
    known = sorted(
        (c for c in candidates if math.isfinite(c.sigma_mm)),
        key=lambda c: (c.sigma_mm, c.design.preview_mm, -c.design.stand_off_mm),
    )
    return [c for c in dict.fromkeys(known) if not any(_beats(other, c) for other in known)]


def _beats(candidate: DesignCandidate, other: DesignCandidate) -> bool:
    a, b = candidate.design, other.design
    if a.preview_mm > b.preview_mm or a.stand_off_mm < b.stand_off_mm:
        return False
    if a.preview_mm < b.preview_mm or a.stand_off_mm > b.stand_off_mm:
        return candidate.sigma_mm <= (1.0 + EQUAL_SIGMA_SHARE) * other.sigma_mm
    return candidate.sigma_mm < other.sigma_mm


def _light(setup: Setup, T_base_tool: Float64, level_e: float) -> SampledStripe | None:
    try:
        return stripe_light(setup, T_base_tool, level_e)
    except ValueError:
        return None


def _brightest(pixels: Sequence[ExpectedPixels | None]) -> float:
    return max((float(p.mean_e.max(initial=0.0)) for p in pixels if p is not None), default=0.0)


def _percentile_of_known(values: Float64) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, PERCENTILE, method="higher")) if len(known) else math.nan


def _step(values: Sequence[float]) -> float:
    return (max(values) - min(values)) / max(len(values) - 1, 1)

"""Reading the stripe: the band around its expected place, the background beside it, path and fit."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL, ArcKernel, ArcMap
from noise_model.arrays import Float32, Float64, Int64
from noise_model.robust import sigma_of
from tracker.arc.level import MAP_SIGMA, ArcLevel
from tracker.arc.transmission import Transmission
from tracker.geometry import MAP_FLOOR_E, MAP_TOLERANCE, SEARCH_REACH_MM, SensorGeometry
from tracker.state import Frame, Stripe
from tracker.stripe.band import AS_IT_IS, Band, LightLevel, gather_band, median_background
from tracker.stripe.detection import Evidence
from tracker.stripe.edge import StripeLight
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit_band import Noise, ReadRoom
from tracker.stripe.read_band import UsualLine, read_band
from tracker.stripe.scatter import Scatter
from tracker.stripe.viterbi import OFFSET_STEP

MEDIAN_HALF_PX = 30
MEDIAN_SIGMA = 1.0
"""Without an arc map: half the running median's length, and its background's relative 1 sigma (anything)."""


class Work(NamedTuple):
    """Preallocated scratch whose contents never matter: flat pixels for the widest band, rooms for lines."""

    room: ReadRoom
    pixels: Band

    @classmethod
    def of(cls, geometry: SensorGeometry) -> Work:
        """Make room for the widest band of a sensor, and for the offsets of a search."""
        n = geometry.n_scan * geometry.n_pos
        n_offsets = len(_offsets_px(math.floor(geometry.reach_px(SEARCH_REACH_MM))))
        charge, background, residual, variance, plain = np.empty((5, n), np.float32)
        censored, lows = np.empty(n, np.bool_), np.empty(-(-geometry.n_scan // CELL), np.int64)
        pixels = Band(charge, background, residual, variance, plain, censored, lows)
        work = cls(ReadRoom.empty(geometry.n_scan, n_offsets), pixels)
        _write_once(work)
        return work


def _write_once(room: object) -> None:
    """Write to all arrays of a record and of the records in it.

    Memory that is new is given when it is first written to, by a virtual machine's host once more. A search's
    first frame of 1280x1024 waited 40 ms for it.
    """
    if isinstance(room, np.ndarray):
        room.fill(0)
    elif isinstance(room, tuple):
        for part in room:
            _write_once(part)


@lru_cache
def _offsets_px(reach_px: int) -> Int64:
    """Return the offsets (n,) from the expected place at which a stripe is sought; not to be written to."""
    return np.arange(-reach_px, reach_px + 1, OFFSET_STEP)


class StripeReading(NamedTuple):
    """A stripe, and what it was read from: explaining a frame asks for that.

    All but the stripe and the scatter are views of the scratch, good until the next frame; `lows` says where
    the band begins for each CELL scan lines. `score` (n_scan, n_offsets) is the matched filter's, in sigmas,
    at `offsets_px` from the rounded expected place; `start_px` (n_scan,) is where the likeliest path runs,
    NaN for no stripe; `tried` and `fits` (n_scan, 7) are those of `LineFits`. The variance of a pixel is
    `shot` times its mean plus `dark_variance_e2`; `map_sigma` is the background's relative 1 sigma,
    `base_sigma_e` that of the black level and of the hall's light.
    `second_share` is how bright a second stripe is over the first, 0 for none; the background has its light.
    `told_nats` is the evidence that the other one is the reflection, infinite where none is searched.
    `scatter` is what the frames up to this one show of it, `learned` what this one was read with.
    `misfit_px` (n_scan,) is by how much each centre may be off, alike with its neighbours', for light beneath
    it that is not as expected. `usual` is what is usual for a line, `evidence` what tells whether there is a
    stripe, `width_px` (n_scan,) the lines' fitted 1 sigma across it. Where `n_lines` (n_scan,) is 2, an even
    line and the next were read as one: the fits of both are what either would say alone.
    """

    stripe: Stripe
    band: Band
    lows: Int64
    offsets_px: Int64
    score: Float32
    start_px: Float64
    tried: Float64
    fits: Float64
    shot: float
    dark_variance_e2: float
    map_sigma: float
    base_sigma_e: float
    second_share: float
    told_nats: float
    scatter: Scatter
    learned: Scatter
    misfit_px: Float64
    usual: UsualLine
    evidence: Evidence
    width_px: Float64
    n_lines: Int64

    def light(self, psf_sigma_px: float, sheet_lines: float) -> StripeLight:
        """Return what shows where the stripe ends, as good as the band."""
        band, usual = self.band, self.usual
        return StripeLight(
            band.charge,
            band.background,
            band.variance,
            band.censored,
            self.lows,
            self.stripe.position_px,
            self.width_px,
            self.shot,
            usual.contrast,
            usual.alike,
            psf_sigma_px,
            sheet_lines,
            usual.centre_sigma_px,
        )


def arc_map_of(geometry: SensorGeometry, kernel: ArcKernel) -> ArcMap:
    """Return the arc map that a frame is read with."""
    return ArcMap.of(
        kernel,
        geometry.xy,
        geometry.cos4,
        geometry.n_scan,
        MAP_TOLERANCE,
        MAP_FLOOR_E,
        geometry.baked_light,
    )


def read_stripe(
    geometry: SensorGeometry,
    arc_map: ArcMap,
    transmission: Transmission | None,
    arc: ArcLevel,
    frame: Frame,
    expected: ExpectedStripe,
    reach_px: float,
    work: Work,
    use_arc_map: bool,
    scatter: Scatter,
    is_searching: bool,
) -> StripeReading:
    """Find the stripe within `reach_px` of its expected place and fit its centre in every scan line.

    `scatter` is what earlier frames show of it; this frame's is added before it is used. `is_searching` says
    whether the joint may lie far off its expected place.
    """
    band = gather_band(
        frame.image_dn,
        geometry.along_rows,
        expected.position_px,
        expected.widest_px,
        reach_px,
        geometry.n_pos,
        geometry.charge_e,
        geometry.saturation_dn,
        work.pixels,
    )
    shot, dark_variance = 1.0, geometry.dark_variance_at(band.charge)
    level_known = math.isfinite(arc.level)
    level = arc.level if level_known else 1.0
    level_sigma = 0.0 if level_known else geometry.setup.tolerance.arc_level_rel
    map_sigma = math.hypot(MAP_SIGMA * max(1.0, arc.misfit if level_known else 1.0), level_sigma)
    light = AS_IT_IS
    if use_arc_map:
        light = _predict_background(geometry, arc_map, transmission, level, arc.black_e, band)
    else:
        median_background(band.charge, MEDIAN_HALF_PX, band.background)
        variance = sigma_of(band.charge - band.background) ** 2
        shot, map_sigma, dark_variance = 0.0, MEDIAN_SIGMA, max(variance, dark_variance)
    black_sigma = geometry.setup.tolerance.black_level_dn * geometry.setup.sensor.gain_e_per_dn
    base_sigma = math.hypot(black_sigma, arc.ambient_e)
    room, offsets_px = work.room, _offsets_px(math.floor(reach_px))
    seen = read_band(
        band,
        light,
        expected,
        offsets_px,
        Noise(shot, dark_variance, map_sigma, base_sigma),
        scatter.average,
        scatter.frames,
        is_searching,
        reach_px,
        geometry.setup.camera.psf_sigma_px,
        geometry.n_pos,
        geometry.along_rows,
        room,
    )
    return StripeReading(
        seen.stripe,
        band,
        band.lows,
        seen.offsets_px,
        seen.score,
        room.start_px,
        room.lines.tried,
        room.lines.fits,
        shot,
        dark_variance,
        map_sigma,
        base_sigma,
        seen.told.share,
        seen.told.nats,
        Scatter(seen.after, scatter.frames + 1),
        Scatter(seen.read_with, max(scatter.frames, 1)),
        room.misfit_px,
        seen.usual,
        seen.evidence,
        seen.width_px,
        room.n_lines,
    )


def _predict_background(
    geometry: SensorGeometry,
    arc_map: ArcMap,
    transmission: Transmission | None,
    level: float,
    black_e: float,
    band: Band,
) -> LightLevel:
    """Write the arc's light and other light into the band; return to which level it is to be brought.

    `level` is the frame's own, `black_e` the black level's.
    """
    if level == 0.0 and transmission is None:
        band.background[:] = 0.0
        return LightLevel(1.0, black_e)
    arc_map.fill(band.lows, band.background)
    if transmission is None:
        return LightLevel(level, black_e)
    n_scan, depth = band.background.shape
    first = np.arange(n_scan) * geometry.n_pos + band.lows[np.arange(n_scan) // CELL]
    pixels = (first[:, None] + np.arange(depth)).ravel()
    arc_e, other_e = transmission.through(pixels, band.background.ravel())
    band.background[:] = (np.float32(level) * arc_e + other_e).reshape(n_scan, depth)
    return LightLevel(1.0, black_e)

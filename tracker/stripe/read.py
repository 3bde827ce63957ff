"""Reading the stripe: the band around its expected place, the background beside it, path and fit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.fill import fill_band
from noise_model.arc.map import CELL, ArcKernel, ArcMap
from noise_model.arc.table import FaceTable
from noise_model.arrays import Float32, Float64, Int64, Integers
from noise_model.kernel import kernel
from noise_model.robust import MAD_SIGMA
from tracker.arc.level import MAP_SIGMA, ArcLevel
from tracker.geometry import (
    MAP_FLOOR_E,
    MAP_TOLERANCE,
    SEARCH_REACH_MM,
    LookSource,
    SensorGeometry,
    dark_variance_at,
)
from tracker.state import Stripe
from tracker.stripe.band import Band, LightLevel, gather_band, median_background
from tracker.stripe.detection import Evidence
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit_band import Noise, ReadRoom, Sought
from tracker.stripe.light import StripeLight
from tracker.stripe.read_band import UsualLine, read_band
from tracker.stripe.scatter import Scatter
from tracker.stripe.viterbi import bin_for, offsets_within

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
        # Bins of several pixels have fewer.
        n_offsets = len(offsets_within(geometry.reach_px(SEARCH_REACH_MM), 1))
        charge, background, light, plain = np.empty((4, n), np.float32)
        censored, lows = np.empty(n, np.bool_), np.empty(-(-geometry.n_scan // CELL), np.int64)
        pixels = Band(charge, background, light, plain, censored, lows)
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


class StripeReading(NamedTuple):
    """A stripe, and what it was read from: explaining a frame asks for that.

    All but the stripe and the scatter are views of the scratch, good until the next frame; `lows` says where
    the band begins for each CELL scan lines. `score` (n_scan, n_offsets) is the matched filter's, in sigmas,
    at `offsets_px` from `around_px` (n_scan,), next to the expected places, in sums of `bin_px`; `start_px`
    (n_scan,) is where the likeliest path runs, NaN for no stripe; `tried` and `fits` (n_scan, 7) are those of
    `LineFits`. The variance of a pixel is `shot` times its mean plus `dark_variance_e2`; `map_sigma` is the
    background's relative 1 sigma, `base_sigma_e` that of the black level and of the hall's light.
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
    around_px: Float64
    offsets_px: Int64
    bin_px: int
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


@kernel(allocates=True)
def light_of(reading: StripeReading, psf_sigma_px: float, sheet_lines: float) -> StripeLight:
    """Return what shows where the stripe ends, as good as the band."""
    band, usual = reading.band, reading.usual
    return StripeLight(
        band.charge,
        band.background,
        band.censored,
        reading.lows,
        reading.stripe.position_px,
        reading.width_px,
        reading.shot,
        reading.dark_variance_e2,
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


class LitBand(NamedTuple):
    """A band with what lights it beside the laser; `light` is the level to which that is to be brought."""

    band: Band
    light: LightLevel
    noise: Noise


@kernel
def level_or_expected(arc: ArcLevel) -> float:
    """Return the arc's level, the expected one where it is not known."""
    return arc.level if math.isfinite(arc.level) else 1.0


@kernel(allocates=True)
def light_band(
    source: LookSource,
    arc_kernel: ArcKernel,
    table: FaceTable,
    arc: ArcLevel,
    image_dn: Integers,
    expected: ExpectedStripe,
    reach_px: float,
    work: Work,
    use_arc_map: bool,
    has_effects: bool,
) -> LitBand:
    """Gather the band about the expected stripe, and predict what lights it beside the laser.

    That is the arc's map at its expected output, which `has_effects` says is still to pass effects.
    """
    image = source.image
    band = gather_band(
        image_dn,
        image.along_rows,
        expected.position_px,
        expected.widest_px,
        reach_px,
        image.n_pos,
        image.charge_e,
        image.saturation_dn,
        work.pixels,
    )
    dark_e2 = dark_variance_at(image, band.charge.reshape(-1))
    base_sigma_e = math.hypot(image.black_sigma_e, arc.ambient_e)
    if not use_arc_map:
        median_background(band.charge, MEDIAN_HALF_PX, band.background)
        scatter_e = MAD_SIGMA * np.float64(np.median(np.abs(band.charge - band.background)))
        noise = Noise(0.0, max(scatter_e**2, dark_e2), MEDIAN_SIGMA, base_sigma_e)
        return LitBand(band, LightLevel(1.0, 0.0), noise)
    level, level_sigma, misfit = level_or_expected(arc), source.arc_level_rel, 1.0
    if math.isfinite(arc.level):
        level_sigma, misfit = 0.0, max(1.0, arc.misfit)
    noise = Noise(1.0, dark_e2, math.hypot(MAP_SIGMA * misfit, level_sigma), base_sigma_e)
    if level == 0.0 and not has_effects:
        for s in range(band.background.shape[0]):
            for j in range(band.background.shape[1]):
                band.background[s, j] = np.float32(0.0)
        return LitBand(band, LightLevel(1.0, arc.black_e), noise)
    fill_band(
        arc_kernel,
        table,
        image.xy,
        image.cos4,
        source.arc.node_at,
        source.arc.node_rules,
        band.lows,
        CELL,
        band.background,
    )
    return LitBand(band, LightLevel(level, arc.black_e), noise)


@kernel(allocates=True)
def read_stripe(
    source: LookSource,
    lit: LitBand,
    expected: ExpectedStripe,
    reach_px: float,
    room: ReadRoom,
    scatter: Scatter,
    is_searching: bool,
) -> StripeReading:
    """Find the stripe within `reach_px` of its expected place and fit its centre in every scan line.

    `scatter` is what earlier frames show of it; this frame's is added before it is used. `is_searching` says
    whether the joint may lie far off its expected place.
    """
    band, noise, bin_px = lit.band, lit.noise, bin_for(expected.sigma_px)
    reads_pairs = scatter.frames > 0 and not is_searching
    seen = read_band(
        band,
        lit.light,
        expected,
        Sought(offsets_within(reach_px, bin_px), bin_px, reach_px, is_searching, reads_pairs),
        noise,
        scatter.average,
        scatter.frames,
        source.stripe.psf_sigma_px,
        source.image.n_pos,
        source.image.along_rows,
        room,
    )
    return StripeReading(
        seen.stripe,
        band,
        band.lows,
        room.around_px,
        seen.offsets_px,
        bin_px,
        seen.score,
        room.start_px,
        room.lines.tried,
        room.lines.fits,
        noise.shot,
        noise.dark_e2,
        noise.map_rel,
        noise.base_e,
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

"""Reading of the stripe: the band around its expected place, the background, path and fit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL, ArcKernel, ArcMap
from noise_model.arc.scratch import ArcScratch
from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.robust import MAD_SIGMA
from tracker.arc.level import MAP_SIGMA, ArcLevel
from tracker.geometry import MAP_FLOOR_E, MAP_TOLERANCE, SEARCH_REACH_MM, ImageSource, SensorGeometry
from tracker.state import AMPLITUDE_E, BESIDE_PX, CENTRE_PX, N_ROWS, OWN_PX, SIGMA_PX, WIDTH_PX, Stripe
from tracker.stripe.band import Band, LightLevel, at_level, median_background
from tracker.stripe.detection import Evidence, evidence_of
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit_band import (
    MAX_SCORE_LOST,
    ReadRoom,
    SearchRange,
    UsualLine,
    bin_for,
    fit_band,
    fit_path,
    offsets_within,
    score_lost,
    usual_line,
    write_lines,
)
from tracker.stripe.ghost import read_without_second
from tracker.stripe.light import EdgeLines, StripeLight
from tracker.stripe.line_fit.first_guess import PixelVariance
from tracker.stripe.scatter import N_NUMBERS, FrameScatter, Scatter, add_frame, width_factor

MEDIAN_HALF_PX = 30
MEDIAN_SIGMA = 1.0
"""Without an arc map: half the running median's length, and its background's relative 1 sigma (anything)."""


class Work(NamedTuple):
    """Preallocated scratch for lines, the widest band's pixels, and the arc; its contents never matter."""

    room: ReadRoom
    pixels: Band
    arc: ArcScratch

    @classmethod
    def of(cls, geometry: SensorGeometry) -> Work:
        """Make room for the widest band of a sensor, and for the offsets of a search."""
        n = len(geometry.cos4)
        # Bins of several pixels have fewer.
        n_offsets = len(offsets_within(geometry.reach_px(SEARCH_REACH_MM), 1))
        charge, background, light, plain = np.empty((4, n), np.float32)
        censored, lows = np.empty(n, np.bool_), np.empty(-(-geometry.n_scan // CELL), np.int64)
        pixels = Band(charge, background, light, plain, censored, lows)
        arc = ArcScratch.of(geometry.seam_source.scene.shape.vertices)
        work = cls(ReadRoom.empty(geometry.n_scan, n_offsets), pixels, arc)
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

    All but the stripe and the scatter are views of the scratch, good until the next frame. `score`
    (n_scan, n_offsets) is the matched filter's, in sigmas, at `offsets_px` from `around_px` (n_scan,), next
    to the expected places, in sums of `bin_px`; `start_px` (n_scan,) is where the likeliest path runs, NaN
    for no stripe; `tried` and `fits` (n_scan, 7) are those of `LineFits`.
    `second_share` is how bright a second stripe is over the first, 0 for none; the background has its light.
    `stripe_choice_nats` is the evidence that the other one is the reflection, infinite where none is sought.
    `scatter` is what the frames up to this one show of it, `learned` what this one was read with.
    `usual` is what is usual for a line, `evidence` that of a stripe. `lines`
    (N_ROWS, n_scan) are the stripe's scan lines. Where `N_LINES` is 2, an even line and the next were read as
    one: the fits of both are what either would say alone.
    """

    stripe: Stripe
    band: Band
    around_px: Float64
    offsets_px: Int64
    bin_px: int
    score: Float32
    start_px: Float64
    tried: Float64
    fits: Float64
    noise: PixelVariance
    second_share: float
    stripe_choice_nats: float
    scatter: Scatter
    learned: Scatter
    usual: UsualLine
    evidence: Evidence
    lines: Float64


def light_of(reading: StripeReading, psf_sigma_px: float, edge: EdgeLines) -> StripeLight:
    """Return the light that shows the stripe's ends, valid as long as the band."""
    band, usual = reading.band, reading.usual
    return StripeLight(
        charge_e=band.charge,
        background_e=band.background,
        censored=band.censored,
        lows=band.lows,
        position_px=reading.stripe.position_px,
        width_px=reading.lines[WIDTH_PX],
        shot=reading.noise.shot,
        dark_variance_e2=reading.noise.dark_e2,
        contrast=usual.contrast,
        correlation=usual.correlation,
        psf_sigma_px=psf_sigma_px,
        edge=edge,
        centre_sigma_px=usual.centre_sigma_px,
    )


def arc_map_of(geometry: SensorGeometry, kernel: ArcKernel) -> ArcMap:
    """Return the arc map that a frame is read with."""
    return ArcMap.of(
        kernel, geometry.xy, geometry.cos4, geometry.n_scan, MAP_TOLERANCE, MAP_FLOOR_E, geometry.baked_light
    )


class LitBand(NamedTuple):
    """A band with the light other than the laser's; `light` is the level to which that is scaled."""

    band: Band
    light: LightLevel
    noise: PixelVariance


def over_median(band: Band, dark_e2: float, base_sigma_e: float) -> LitBand:
    """Return a band over the running median of each scan line, with one variance for all pixels."""
    median_background(band.charge, MEDIAN_HALF_PX, band.background)
    scatter_e = MAD_SIGMA * float(np.median(np.abs(band.charge - band.background)))
    noise = PixelVariance(0.0, max(scatter_e**2, dark_e2), MEDIAN_SIGMA, base_sigma_e)
    return LitBand(band, LightLevel(1.0, 0.0), noise)


def over_arc_map(
    band: Band, arc: ArcLevel, dark_e2: float, base_sigma_e: float, arc_level_rel: float
) -> LitBand:
    """Return a band over the arc's light, which its background holds at the expected output.

    Where the level is not known it is the expected one, within the stated tolerance.
    """
    level, map_sigma = 1.0, math.hypot(MAP_SIGMA, arc_level_rel)
    if math.isfinite(arc.level):
        level, map_sigma = arc.level, MAP_SIGMA * max(1.0, arc.misfit)
    return LitBand(band, LightLevel(level, arc.black_e), PixelVariance(1.0, dark_e2, map_sigma, base_sigma_e))


def read_stripe(
    image: ImageSource,
    psf_sigma_px: float,
    lit: LitBand,
    expected: ExpectedStripe,
    reach_px: float,
    room: ReadRoom,
    scatter: Scatter,
    is_searching: bool,
) -> StripeReading:
    """Find the stripe within `reach_px` of its expected place and fit its centre in every scan line.

    `scatter` is what earlier frames show of it; this frame's is added before it is used. `is_searching` says
    whether the joint may lie far off its expected place. A first frame is read with what it shows itself.
    """
    band, noise, bin_px = lit.band, lit.noise, bin_for(expected.sigma_px)
    before, frames = scatter.average.numbers, scatter.frames
    reads_pairs = frames > 0 and not is_searching
    search = SearchRange(offsets_within(reach_px, bin_px), bin_px, reach_px, is_searching, reads_pairs)
    at_level(band.background, lit.light)
    fit_band(band, expected, search, noise, before, room)
    read_with, after = before, np.empty(N_NUMBERS)
    if frames == 0:
        read_with = np.empty(N_NUMBERS)
        add_frame(before, 0, room.seen, read_with)
        # A stripe of another width is sought anew. Of a search no more is asked than where the joint is.
        if score_lost(width_factor(before) / width_factor(read_with)) > MAX_SCORE_LOST:
            fit_band(band, expected, search, noise, read_with, room)
        elif not is_searching:
            np.multiply(width_factor(read_with), expected.sigma_px, out=room.width_px)
            fit_path(band, expected, search, noise, read_with, room)
    second = read_without_second(band, expected, search, noise, read_with, room)
    add_frame(before, frames, room.seen, after)
    n_scan, n = len(expected.position_px), second.n_offsets
    lines = np.empty((N_ROWS, n_scan))
    write_lines(
        fits=room.lines,
        n_lines=room.n_lines,
        expected_sigma_px=expected.sigma_px,
        bias_px=expected.bias_px,
        learned=after,
        psf_sigma_px=psf_sigma_px,
        values=room.values,
        scratch=room.scratch,
        lines=lines,
    )
    stripe = Stripe(
        position_px=lines[CENTRE_PX],
        sigma_px=lines[SIGMA_PX],
        amplitude_e=lines[AMPLITUDE_E],
        saturated=room.lines.saturated.copy(),
        along_rows=image.along_rows,
        beside_px=lines[BESIDE_PX],
    )
    offsets_px = search.offsets_px[second.first : second.first + n]
    score = room.score[: n_scan * n].reshape((n_scan, n))
    evidence = evidence_of(
        position_px=stripe.position_px,
        saturated=stripe.saturated,
        expected_px=expected.position_px,
        sigma_px=expected.sigma_px,
        shown=expected.shown,
        n_pos=image.n_pos,
        score=score,
        around_px=room.around_px,
        offsets_px=offsets_px,
        bin_px=bin_px,
        learned=read_with,
        room=room.values,
    )
    return StripeReading(
        stripe=stripe,
        band=band,
        around_px=room.around_px,
        offsets_px=offsets_px,
        bin_px=bin_px,
        score=score,
        start_px=room.start_px,
        tried=room.lines.tried,
        fits=room.lines.fits,
        noise=noise,
        second_share=second.share,
        stripe_choice_nats=second.nats,
        scatter=Scatter(FrameScatter.of(after), frames + 1),
        learned=Scatter(FrameScatter.of(read_with), max(frames, 1)),
        usual=usual_line(after, lines[OWN_PX]),
        evidence=evidence,
        lines=lines,
    )

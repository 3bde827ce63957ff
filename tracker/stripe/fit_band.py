"""The likeliest path through a band, the fits along it, and what these say of each line.

The order is Python's; a kernel seeks the path, one fits the lines, one sees how they scatter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median, finite_median, numbers_for
from tracker.state import (
    AMPLITUDE_E,
    BESIDE_PX,
    BIAS_PX,
    CENTRE_PX,
    MISFIT_PX,
    N_LINES,
    OWN_PX,
    SCAN,
    SIGMA_PX,
    WIDTH_PX,
)
from tracker.stripe.band import Band
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.frame_scatter import N_SCRATCH, OFF, frame_scatter, own_sigma
from tracker.stripe.line_fit.first_guess import PixelVariance
from tracker.stripe.line_fit.lines import FitRoom, LineFits, Scans, fit_lines, fit_room
from tracker.stripe.neighbours import mark_pairs, misfit_sigma_px, tell_both, write_centres_as_one
from tracker.stripe.scatter import (
    N_NUMBERS,
    brightness_correlation,
    brightness_plateau,
    centre_share,
    line_variance_px2,
    pair_contrast,
    weighing_contrast,
    widen,
    width_factor,
    width_limit_ln,
)
from tracker.stripe.viterbi import JUMP_COST, OFFSET_STEP, best_path, matched_filter, middles, peaks

MIN_BINNED_SIGMA = 2.5
"""A wide stripe is sought in sums of neighbouring pixels, of which its sigma holds so many at least.

Sums of b pixels cost a bell's score b^2 / (48 sigma^2) of it, a third of a percent at most; with the
template's mean taken out it is less than one.
"""

MAX_SCORE_LOST = 0.01
"""The share of its score that a stripe may lose to a filter for another width: the path hardly feels it."""


class SearchRange(NamedTuple):
    """Search of a stripe: at `offsets_px` (n,) from its expected place, in sums of `bin_px`.

    `is_searching` says whether the joint may lie far off its expected place, up to `reach_px`. Where a look
    `reads_pairs`, two lines are fitted as one where no corner lies within that reach.
    """

    offsets_px: Int64
    bin_px: int
    reach_px: float
    is_searching: bool
    reads_pairs: bool


class ReadRoom(NamedTuple):
    """Scratch for a frame's lines; `score` is flat, for as many offsets as a search has.

    Offsets are from `around_px` (n_scan,). The path's index among them is `choice` (n_scan,), -1 for none;
    there each line's fit starts, at `start_px`, for a stripe of 1 sigma `width_px`. Each line was read with
    `n_lines`, and its 1 sigma by photons is `own_px`. `seen` (N_NUMBERS,) is the frame's scatter.
    """

    score: Float32
    choice: Int64
    lines: LineFits
    fit: FitRoom
    is_smooth: Bool
    values: Float32
    scratch: Float64
    seen: Float64
    around_px: Float64
    start_px: Float64
    width_px: Float64
    own_px: Float64
    n_lines: Float64

    @classmethod
    def empty(cls, n_scan: int, n_offsets: int) -> ReadRoom:
        """Make room for so many lines and offsets at most."""
        around_px, start_px, width_px, own_px, n_lines = np.empty((5, n_scan))
        return cls(
            score=np.empty(n_scan * n_offsets, np.float32),
            choice=np.empty(n_scan, np.int64),
            lines=LineFits.empty(n_scan),
            fit=fit_room(n_scan),
            is_smooth=np.ones(n_scan, np.bool_),
            values=np.empty(numbers_for(n_scan), np.float32),
            scratch=np.empty((N_SCRATCH, n_scan)),
            seen=np.empty(N_NUMBERS),
            around_px=around_px,
            start_px=start_px,
            width_px=width_px,
            own_px=own_px,
            n_lines=n_lines,
        )


@kernel
def bin_for(sigma_px: Float64) -> int:
    """Return the pixels of a bin in which stripes of 1 sigma (n,) px are sought: a power of two."""
    narrowest, n = math.inf, 1
    for s in range(sigma_px.shape[0]):
        if sigma_px[s] > 0.0:
            narrowest = min(narrowest, sigma_px[s])
    while math.isfinite(narrowest) and 2.0 * MIN_BINNED_SIGMA * n <= narrowest:
        n *= 2
    return n


def offsets_within(reach_px: float, bin_px: int) -> Int64:
    """Return the offsets (n,), px, at which a stripe is sought within a reach: OFFSET_STEP bins apart."""
    farthest = bin_px * math.ceil(math.floor(reach_px) / bin_px)
    return np.arange(-farthest, farthest + 1, OFFSET_STEP * bin_px)


def score_lost(factor: float) -> float:
    """Return the share of its score that a stripe loses to a matched filter for so many times its width.

    Bells of widths w and k w overlap by sqrt(2 k / (1 + k^2)).
    """
    return 1.0 - math.sqrt(2.0 * factor / (1.0 + factor * factor))


def fit_band(
    band: Band,
    expected: ExpectedStripe,
    search: SearchRange,
    noise: PixelVariance,
    learned: Float64,
    room: ReadRoom,
) -> None:
    """Find the likeliest path through a band, fit its lines and see how they scatter.

    `learned` (N_NUMBERS,) is the scatter that is known.
    """
    np.multiply(width_factor(learned), expected.sigma_px, out=room.width_px)
    _seek_path(
        charge_e=band.charge,
        background_e=band.background,
        lows=band.lows,
        noise=noise,
        expected_px=expected.position_px,
        is_sought=expected.is_sought,
        width_px=room.width_px,
        offsets_px=search.offsets_px,
        bin_px=search.bin_px,
        score=room.score,
        choice=room.choice,
        around_px=room.around_px,
        start_px=room.start_px,
    )
    fit_path(band, expected, search, noise, learned, room)


@kernel(allocates=True)
def _seek_path(
    charge_e: Float32,
    background_e: Float32,
    lows: Int64,
    noise: PixelVariance,
    expected_px: Float64,
    is_sought: Bool,
    width_px: Float64,
    offsets_px: Int64,
    bin_px: int,
    score: Float32,
    choice: Int64,
    around_px: Float64,
    start_px: Float64,
) -> None:
    """Find the likeliest path through a band, and where the fit of each line starts."""
    n_scan, n = charge_e.shape[0], len(offsets_px)
    scores = score[: n_scan * n].reshape((n_scan, n))
    middles(expected_px, lows, bin_px, around_px)
    matched_filter(
        charge_e=charge_e,
        background_e=background_e,
        shot=noise.shot,
        dark_variance_e2=noise.dark_e2,
        around_px=around_px,
        width_px=width_px,
        lows=lows,
        offsets_px=offsets_px,
        bin_px=bin_px,
        score=scores,
    )
    # Where no light can be none is looked for.
    for s in range(n_scan):
        if not is_sought[s]:
            scores[s] = 0.0
    best_path(scores, JUMP_COST * bin_px, choice)
    peaks(scores, choice, around_px, offsets_px, start_px)
    for s in range(n_scan):
        if not is_sought[s]:
            start_px[s], choice[s] = math.nan, -1


def fit_path(
    band: Band,
    expected: ExpectedStripe,
    search: SearchRange,
    noise: PixelVariance,
    learned: Float64,
    room: ReadRoom,
) -> None:
    """Fit the lines of a band along the path and with the widths in the room, and see how they scatter."""
    if search.reads_pairs:
        mark_pairs(
            choice=room.choice,
            face=expected.face,
            expected_px=expected.position_px,
            width_px=room.width_px,
            reach_px=search.reach_px,
            n_lines=room.n_lines,
            is_smooth=room.is_smooth,
        )
    else:
        room.n_lines.fill(1.0)
        room.is_smooth.fill(True)
    scans = Scans(
        charge=band.charge,
        background=band.background,
        censored=band.censored,
        start=room.start_px,
        width=room.width_px,
        n_lines=room.n_lines,
        lows=band.lows,
    )
    speckled = noise._replace(speckle=weighing_contrast(learned), pair_speckle=pair_contrast(learned))
    fit_lines(scans, speckled, room.fit, room.lines)
    _see_scatter(
        lines=room.lines,
        expected_px=expected.position_px,
        sigma_px=expected.sigma_px,
        width_px=room.width_px,
        n_lines=room.n_lines,
        is_smooth=room.is_smooth,
        learned=learned,
        is_searching=search.is_searching,
        values=room.values,
        scratch=room.scratch,
        own_px=room.own_px,
        seen=room.seen,
    )


@kernel
def _see_scatter(
    lines: LineFits,
    expected_px: Float64,
    sigma_px: Float64,
    width_px: Float64,
    n_lines: Float64,
    is_smooth: Bool,
    learned: Float64,
    is_searching: bool,
    values: Float32,
    scratch: Float64,
    own_px: Float64,
    seen: Float64,
) -> None:
    """Write how the lines' fits scatter, and leave out those that are of no stripe's width."""
    tell_both(expected_px, n_lines, centre_share(learned), lines)
    own_sigma(lines.fits, width_px, n_lines, values, own_px)
    frame_scatter(
        fits=lines.fits,
        expected_px=expected_px,
        width_px=sigma_px,
        sigma_px=own_px,
        core=lines.core,
        n_lines=n_lines,
        is_smooth=is_smooth,
        learned=learned,
        is_searching=is_searching,
        values=values,
        scratch=scratch,
        seen=seen,
    )
    # The limit is that of what is known: a frame without a stripe would widen it for itself.
    limit_ln = width_limit_ln(learned)
    for s in range(width_px.shape[0]):
        if abs(math.log(lines.fits[s, 3] / width_px[s])) > limit_ln:
            lines.fits[s] = math.nan
            lines.odd[s] = math.nan
            lines.saturated[s] = False


class UsualLine(NamedTuple):
    """Contrast and correlation of the lines' brightness, and the median 1 sigma of their centres, px."""

    contrast: float
    correlation: float
    centre_sigma_px: float


@kernel
def _sheet_px(fits: Float64, psf_sigma_px: float, values: Float32, scratch: Float64) -> float:
    """Return the sheet's 1 sigma in the image, px, of the fits (n_scan, 7) of lines; 0 of none."""
    for s in range(fits.shape[0]):
        scratch[s] = fits[s, 3]
    width_px = finite_median(scratch, values)
    return math.sqrt(max(width_px**2 - psf_sigma_px**2, 0.0)) if width_px > 0.0 else 0.0


@kernel(allocates=True)
def write_lines(
    fits: LineFits,
    n_lines: Float64,
    expected_sigma_px: Float64,
    bias_px: Float64,
    learned: Float64,
    psf_sigma_px: float,
    values: Float32,
    scratch: Float64,
    lines: Float64,
) -> None:
    """Write the rows of each line (N_ROWS, n_scan) from the fits, the scatter and its neighbours."""
    sigma_px, beside_px, own_px, as_one = lines[SIGMA_PX], lines[BESIDE_PX], lines[OWN_PX], scratch[OFF]
    own_sigma(fits.fits, expected_sigma_px, n_lines, values, own_px)
    widen(learned, own_px, n_lines, _sheet_px(fits.fits, psf_sigma_px, values, as_one), sigma_px, beside_px)
    for s in range(lines.shape[1]):
        lines[CENTRE_PX, s], lines[AMPLITUDE_E, s] = fits.fits[s, 0], fits.fits[s, 2]
        lines[WIDTH_PX, s], lines[BIAS_PX, s] = fits.fits[s, 3], bias_px[s]
        lines[SCAN, s], lines[N_LINES, s] = s, n_lines[s]
        # Two lines that were read as one tell their misfit once.
        if n_lines[s] > 1.0 and s % 2 == 1:
            fits.odd[s] = math.nan
    write_centres_as_one(sigma_px, beside_px, n_lines, values, as_one)
    misfit_sigma_px(fits.odd, fits.fits, as_one, lines[MISFIT_PX])


@kernel(allocates=True)
def usual_line(average: Float64, own_px: Float64) -> UsualLine:
    """Return the usual line read alone, by the scatter and the lines' own 1 sigma (n,)."""
    known_px, n = np.empty(own_px.shape[0]), 0
    for s in range(own_px.shape[0]):
        if math.isfinite(own_px[s]):
            known_px[n] = own_px[s]
            n += 1
    own_sigma_px = exact_median(known_px[:n])
    centre_sigma_px = math.hypot(own_sigma_px, math.sqrt(line_variance_px2(average)))
    return UsualLine(math.sqrt(brightness_plateau(average)), brightness_correlation(average), centre_sigma_px)

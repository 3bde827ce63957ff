"""The likeliest path through a band, and the fits along it: what a reading does once or a few times."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float32, Float64, Int64
from noise_model.kernel import kernel
from tracker.stripe.band import Band
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.frame_scatter import ScatterRoom, frame_scatter, own_sigma
from tracker.stripe.line_fit.lines import FitRoom, LineFits, fit_lines, fit_room
from tracker.stripe.misfit import MisfitRoom
from tracker.stripe.pairs import mark_pairs, tell_both
from tracker.stripe.scatter import (
    FrameScatter,
    centre_share,
    empty_scatter,
    pair_contrast,
    weighing_contrast,
    width_factor,
    width_limit_ln,
)
from tracker.stripe.viterbi import JUMP_COST, best_path, matched_filter, middles, peaks


class Noise(NamedTuple):
    """A pixel's variance is `shot` times its mean plus `dark_e2`; the background's own 1 sigma.

    `map_rel` is that of the arc map, relative, `base_e` that of the black level and of the hall's light.
    """

    shot: float
    dark_e2: float
    map_rel: float
    base_e: float


class Sought(NamedTuple):
    """Where and how a stripe is sought: at `offsets_px` (n,) from its expected place, in sums of `bin_px`.

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

    Offsets are from `around_px` (n_scan,).
    """

    score: Float32
    choice: Int64
    lines: LineFits
    fit: FitRoom
    n_lines: Int64
    is_smooth: Bool
    scatter: ScatterRoom
    misfit: MisfitRoom
    seen: FrameScatter
    around_px: Float64
    start_px: Float64
    width_px: Float64
    own_px: Float64

    @classmethod
    def empty(cls, n_scan: int, n_offsets: int) -> ReadRoom:
        """Make room for so many lines and offsets at most."""
        return cls(
            np.empty(n_scan * n_offsets, np.float32),
            np.empty(n_scan, np.int64),
            LineFits.empty(n_scan),
            fit_room(n_scan),
            np.ones(n_scan, np.int64),
            np.ones(n_scan, np.bool_),
            ScatterRoom.empty(n_scan),
            MisfitRoom.empty(),
            empty_scatter(),
            *np.empty((4, n_scan)),
        )


MOST_SCORE_LOST = 0.01
"""The share of its score that a stripe may lose to a filter for another width: the path hardly feels it."""


@kernel
def score_lost(factor: float) -> float:
    """Return the share of its score that a stripe loses to a matched filter for so many times its width.

    Bells of widths w and k w overlap by sqrt(2 k / (1 + k^2)).
    """
    return 1.0 - math.sqrt(2.0 * factor / (1.0 + factor * factor))


@kernel
def _write_widths(expected: ExpectedStripe, learned: FrameScatter, width_px: Float64) -> None:
    """Write the 1 sigma (n_scan,) that is expected across the stripe, as much wider as frames have shown."""
    factor = width_factor(learned)
    for s in range(width_px.shape[0]):
        width_px[s] = factor * expected.sigma_px[s]


@kernel(allocates=True)
def _seek_path(
    band: Band,
    expected: ExpectedStripe,
    sought: Sought,
    noise: Noise,
    learned: FrameScatter,
    room: ReadRoom,
) -> None:
    """Find the likeliest path through a band, and where the fit of each line starts."""
    offsets_px, bin_px = sought.offsets_px, sought.bin_px
    n_scan, n = band.charge.shape[0], len(offsets_px)
    _write_widths(expected, learned, room.width_px)
    score = room.score[: n_scan * n].reshape((n_scan, n))
    middles(expected.position_px, band.lows, bin_px, room.around_px)
    matched_filter(
        charge_e=band.charge,
        background_e=band.background,
        shot=noise.shot,
        dark_variance_e2=noise.dark_e2,
        around_px=room.around_px,
        width_px=room.width_px,
        lows=band.lows,
        offsets_px=offsets_px,
        bin_px=bin_px,
        score=score,
    )
    # Where no light can be none is looked for.
    for s in range(n_scan):
        if not expected.is_sought[s]:
            score[s] = 0.0
    best_path(score, JUMP_COST * bin_px, room.choice)
    peaks(score, room.choice, room.around_px, offsets_px, room.start_px)
    for s in range(n_scan):
        if not expected.is_sought[s]:
            room.start_px[s], room.choice[s] = math.nan, -1


@kernel(allocates=True)
def fit_band(
    band: Band,
    expected: ExpectedStripe,
    sought: Sought,
    noise: Noise,
    learned: FrameScatter,
    room: ReadRoom,
) -> None:
    """Find the likeliest path through a band, fit its lines and see how they scatter."""
    _seek_path(band, expected, sought, noise, learned, room)
    fit_path(band, expected, sought, noise, learned, room)


@kernel(allocates=True)
def fit_path(
    band: Band,
    expected: ExpectedStripe,
    sought: Sought,
    noise: Noise,
    learned: FrameScatter,
    room: ReadRoom,
) -> None:
    """Fit the lines of a band along the likeliest path that is known, and see how they scatter."""
    n_scan, lines = band.charge.shape[0], room.lines
    _write_widths(expected, learned, room.width_px)
    for s in range(n_scan):
        room.n_lines[s], room.is_smooth[s] = 1, True
    if sought.reads_pairs:
        mark_pairs(
            room.choice,
            expected.face,
            expected.position_px,
            room.width_px,
            sought.reach_px,
            room.n_lines,
            room.is_smooth,
        )
    fit_lines(
        charge=band.charge,
        background=band.background,
        censored=band.censored,
        start=room.start_px,
        width=room.width_px,
        n_lines=room.n_lines,
        lows=band.lows,
        shot=noise.shot,
        dark_variance=noise.dark_e2,
        speckle=weighing_contrast(learned),
        pair_speckle=pair_contrast(learned),
        map_sigma=noise.map_rel,
        base_sigma=noise.base_e,
        room=room.fit,
        lines=lines,
    )
    if sought.reads_pairs:
        tell_both(expected.position_px, room.n_lines, centre_share(learned), lines)
    own_sigma(lines.fits, room.width_px, room.n_lines, room.scatter.values, room.own_px)
    frame_scatter(
        fits=lines.fits,
        expected_px=expected.position_px,
        width_px=expected.sigma_px,
        sigma_px=room.own_px,
        core=lines.core,
        n_lines=room.n_lines,
        is_smooth=room.is_smooth,
        learned=learned,
        is_searching=sought.is_searching,
        room=room.scatter,
        seen=room.seen,
    )
    # The limit is that of what is known: a frame without a stripe would widen it for itself.
    limit_ln = width_limit_ln(learned)
    for s in range(n_scan):
        if abs(math.log(lines.fits[s, 3] / room.width_px[s])) > limit_ln:
            lines.fits[s] = math.nan
            lines.odd[s] = math.nan
            lines.saturated[s] = False

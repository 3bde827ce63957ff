"""Gauss-Newton on the likelihood of sixteen scan lines at once, a lane a line.

All lanes take the same steps, a few at most; what a lane's fit says is kept when it ends. Those that have not
ended go on together later.
"""

from __future__ import annotations

from typing import NamedTuple

from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import Lanes, Mask, any_lane, root, spread, where
from tracker.stripe.line_fit.normal_equations import (
    Block,
    PixelNoise,
    Prior,
    Unknowns,
    moments_of,
    normal_equations,
    solve,
)

WINDOW_SIGMAS = 4.0
"""The fit reads this many stripe sigmas to either side of the centre: beyond them little depends on it."""

CORRELATION_PX = 30.0
"""Over how many pixels the map's error changes: its slope's 1 sigma is the level's over this."""

MIN_PIXELS = 8
"""Fewer pixels that count tell nothing of five parameters."""

ROUNDS, ROUND_STEPS, LINE_SETTLED = 3, 4, 2e-3
"""Rounds of Gauss-Newton steps at most; a step that gains less of chi2 is the last.

A fit ends within 0.01 of a sigma. Of a speckled stripe's lines one in twelve takes more than a round, of a
wide one's one in five: the others of their vector would wait for them.
"""

WIDTH_SIGMA_LN = 0.1
"""1 sigma of ln(width / predicted width): focus, plate angle."""

MIN_SIGMA_E = 1e-3
"""The least 1 sigma of the background: a black level may be stated as exact."""

MIN_SIGNIFICANCE = 5.0
"""A stripe counts from this amplitude over its 1 sigma."""

MAX_PLACE_STEP, MAX_LN_WIDTH_STEP, MIN_AMPLITUDE_KEPT = 1.0, 0.3, 0.1
"""A step moves the place by a width at most, ln(width) by so much, and leaves this share of the amplitude."""


class LinePrior(NamedTuple):
    """Input of sixteen lines' fits, by lane.

    `start` is where the stripe is expected, px from the window's first pixel, `n` the window's length, px,
    `width` the predicted 1 sigma, px. `amplitude` is the first guess, `level` the map's mean, e-. `offset`
    and `slope` are what is known of the background's, 1 over their variances, e-^-2 and (e-/px)^-2.
    """

    start: Lanes
    n: Lanes
    width: Lanes
    amplitude: Lanes
    level: Lanes
    offset: Lanes
    slope: Lanes


class FitState(NamedTuple):
    """State of sixteen lines' fits between two steps, by lane.

    `width` is px, `off` how far its logarithm lies off the predicted one's; position, offset and slope are as
    `BlockFits` has them. `is_settled` is 1 where the last step was small.
    """

    amplitude: Lanes
    position: Lanes
    width: Lanes
    off: Lanes
    offset: Lanes
    slope: Lanes
    is_settled: Lanes


class BlockFits(NamedTuple):
    """Fits of sixteen lines, by lane, as `lines.LineFits` has them, the place from the window's start.

    `is_done` says where the fit came to its end, `is_stripe` where its amplitude is significant too.
    """

    position: Lanes
    sigma: Lanes
    amplitude: Lanes
    width: Lanes
    chi2: Lanes
    offset: Lanes
    slope: Lanes
    is_done: Mask
    is_stripe: Mask


class StepRound(NamedTuple):
    """Result of a round of steps: fits that came to their end, the state of the others, and which go on."""

    fitted: BlockFits
    reached: FitState
    goes_on: Mask


@kernel
def _clipped(x: Lanes, limit: float) -> Lanes:
    """Return x between -limit and limit."""
    x = where(x < spread(limit), x, spread(limit))
    return where(x > spread(-limit), x, spread(-limit))


@kernel
def larger(a: Lanes, b: Lanes) -> Lanes:
    """Return the larger of two, lane by lane, b where a is NaN."""
    return where(a > b, a, b)


@kernel(fastmath=REDUCTION)
def _exponential(x: Lanes) -> Lanes:
    """Return exp(x) for |x| up to MAX_LN_WIDTH_STEP, 1e-7 off at most."""
    unity = spread(1.0)
    high = spread(1.0 / 24.0) + x * (spread(1.0 / 120.0) + x * spread(1.0 / 720.0))
    return unity + x * (unity + x * (spread(0.5) + x * (spread(1.0 / 6.0) + x * high)))


@kernel
def _merged(mask: Mask, new: BlockFits, old: BlockFits) -> BlockFits:
    """Return the new fits in the lanes of a mask, the old ones in the others."""
    return BlockFits(
        position=where(mask, new.position, old.position),
        sigma=where(mask, new.sigma, old.sigma),
        amplitude=where(mask, new.amplitude, old.amplitude),
        width=where(mask, new.width, old.width),
        chi2=where(mask, new.chi2, old.chi2),
        offset=where(mask, new.offset, old.offset),
        slope=where(mask, new.slope, old.slope),
        is_done=where(mask, new.is_done, old.is_done),
        is_stripe=where(mask, new.is_stripe, old.is_stripe),
    )


@kernel(fastmath=REDUCTION)
def _judged(
    ended: BlockFits, used: Lanes, variances: tuple[Lanes, Lanes], level: Lanes, noise: PixelNoise
) -> BlockFits:
    """Return fits that ended with their sigmas, widened by chi2, and whether a stripe is there.

    `ended.chi2` is the whole sum, `ended.sigma` the width, px, that the unknown place is over. `variances`
    are those of amplitude and place.
    """
    # Three of the five parameters brought a prior, whose term is counted too.
    freedom = used - spread(2.0)
    chi2 = ended.chi2 / freedom
    # Only what chi2 shows beyond its own scatter widens the sigmas: else chance alone would, on average.
    excess = larger(chi2 - root(spread(2.0) / freedom), spread(1.0))
    # Where there is no stripe there is no speckle: a stripe is detected without it.
    without = larger(noise.shot * (level + ended.amplitude) + noise.dark, spread(MIN_SIGMA_E**2))
    grains = noise.speckle * ended.amplitude
    unspeckled = without / (without + grains * grains)
    is_significant = ended.amplitude >= spread(MIN_SIGNIFICANCE) * root(variances[0] * excess * unspeckled)
    return BlockFits(
        position=ended.position,
        sigma=root(variances[1] * excess) * ended.sigma,
        amplitude=ended.amplitude,
        width=ended.width,
        chi2=chi2,
        offset=ended.offset,
        slope=ended.slope,
        is_done=ended.is_done,
        is_stripe=is_significant,
    )


@kernel
def first_state(known: LinePrior) -> FitState:
    """Return the state of fits before their first step."""
    zero = spread(0.0)
    return FitState(known.amplitude, known.start, known.width, zero, zero, zero, zero)


@kernel(fastmath=REDUCTION)
def fit_block(
    block: Block, n: int, known: LinePrior, noise: PixelNoise, reached: FitState, is_last: bool
) -> StepRound:
    """Fit the first n pixels of sixteen lines by Gauss-Newton on the likelihood, see `lines.fit_lines`.

    One round of steps is taken; in the last one what is sound ends.
    """
    zero, unity = spread(0.0), spread(1.0)
    no = zero > unity
    narrow = spread(WIDTH_SIGMA_LN**-2)
    amplitude, position, width, off, offset, slope, settled = reached
    runs, is_settled = zero < unity, settled > zero
    fitted = BlockFits(
        position=known.start,
        sigma=zero,
        amplitude=zero,
        width=known.width,
        chi2=zero,
        offset=zero,
        slope=zero,
        is_done=no,
        is_stripe=no,
    )
    for turn in range(ROUND_STEPS):
        inverse = unity / width
        x = Unknowns(amplitude, position * inverse, offset, slope * width)
        prior = Prior(narrow, known.offset, known.slope * inverse * inverse, off)
        moments = moments_of(block, n, x, inverse, noise)
        solved = solve(normal_equations(moments, x, prior))
        chi2 = moments.chi2 + off * off * narrow
        chi2 += x.offset * x.offset * prior.offset + x.slope * x.slope * prior.slope
        amplitude = larger(amplitude + solved.step_0, spread(MIN_AMPLITUDE_KEPT) * amplitude)
        position += _clipped(solved.step_1, MAX_PLACE_STEP) * width
        by_ln = _clipped(solved.step_2, MAX_LN_WIDTH_STEP)
        off += by_ln
        offset += solved.step_3
        slope += solved.step_4 * inverse
        unit, width = width, width * _exponential(by_ln)
        is_sound = solved.is_positive & (moments.used >= spread(MIN_PIXELS))
        is_sound = is_sound & (position > zero) & (position < known.n - unity)
        # A fit whose width leaves the predicted one by a larger ln has lost its stripe.
        runs = runs & is_sound & (off * off <= spread(1.0**2))
        is_small = solved.gained < spread(LINE_SETTLED)
        # The last step may let a saturated pixel count, or no more: what they tell is asked once again.
        ends = runs & is_small & (is_settled | (moments.used == known.n))
        if is_last and turn == ROUND_STEPS - 1:
            ends = runs
        if any_lane(ends):
            there = BlockFits(
                position=position,
                sigma=unit,
                amplitude=amplitude,
                width=width,
                chi2=chi2,
                offset=offset,
                slope=slope,
                is_done=runs,
                is_stripe=runs,
            )
            variances = solved.variance_0, solved.variance_1
            fitted = _merged(ends, _judged(there, moments.used, variances, known.level, noise), fitted)
        runs = where(ends, no, runs)
        if not any_lane(runs):
            break
        is_settled = is_small
    settled = where(is_settled, unity, zero)
    return StepRound(fitted, FitState(amplitude, position, width, off, offset, slope, settled), runs)

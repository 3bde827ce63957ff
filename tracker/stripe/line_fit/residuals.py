"""Residuals of sixteen scan lines' fits: their scatter about the bell, and their odd part."""

from __future__ import annotations

from noise_model.compiled.arrays import Float32
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import N_LANES, Lanes, least, load, spread, store, where
from tracker.stripe.line_fit.block import WINDOW_SIGMAS, BlockFits, larger
from tracker.stripe.line_fit.normal_equations import COUNTS, HIDDEN, Block, PixelNoise, bells

CORE_SIGMAS = 1.5
"""So near to a bell's middle its light is compared with a line's pixels."""

SATURATED_SIGMAS = 2.0
"""A line with a saturated pixel so near to its centre, in expected sigmas, is saturated."""

N_BINS = 4
"""Into so many parts of a side's window a line's odd residual is averaged."""

LAST_BIN = 0.5
"""A line whose window ends before this share of its last bin shows no odd residual."""


@kernel(fastmath=REDUCTION)
def core_square(block: Block, n: int, fit: BlockFits, width: Lanes, noise: PixelNoise) -> tuple[Lanes, Lanes]:
    """Return the square of the contrast by which each line's pixels scatter about its bell, and if some hide.

    Within a line's core the residuals' squares are the photons' variance and the square of contrast times
    light; NaN of lines none of whose pixels there count. Hidden, 1 or 0, is whether a pixel within
    SATURATED_SIGMAS of the expected `width` is censored.
    """
    zero = spread(0.0)
    over, light, hidden = zero, zero, zero
    reach = spread(SATURATED_SIGMAS) * width
    inverse = spread(1.0) / fit.width
    far = larger(reach, spread(CORE_SIGMAS) * fit.width)
    first, last = max(int(least(fit.position - far)), 0), min(int(-least(zero - fit.position - far)), n - 1)
    for j in range(first, last + 1):
        away, kind = spread(j) - fit.position, load(block.kind, j * N_LANES)
        t = away * inverse
        bell = fit.amplitude * bells(t)
        background = load(block.background, j * N_LANES)
        off = load(block.charge, j * N_LANES) - background - bell
        mean = bell + background
        lit = where(mean > zero, mean, zero)
        counts = (kind == spread(COUNTS)) & (t * t <= spread(CORE_SIGMAS**2))
        over += where(counts, off * off - noise.shot * lit - noise.dark, zero)
        light += where(counts, bell * bell, zero)
        is_hidden = (kind == spread(HIDDEN)) & (away * away <= reach * reach)
        hidden = where(is_hidden, spread(1.0), hidden)
    return over / light, hidden


@kernel(fastmath=REDUCTION)
def _leave(block: Block, n: int, fit: BlockFits) -> None:
    """Put what each line's fit leaves of its pixels, e-, in the background's place; 0 of censored ones."""
    zero = spread(0.0)
    inverse = spread(1.0) / fit.width
    for j in range(n):
        away = spread(j) - fit.position
        mean = fit.amplitude * bells(away * inverse) + load(block.background, j * N_LANES)
        mean += fit.offset + fit.slope * away
        counts = load(block.kind, j * N_LANES) == spread(COUNTS)
        store(block.background, j * N_LANES, where(counts, load(block.charge, j * N_LANES) - mean, zero))


@kernel(fastmath=REDUCTION)
def _mean_between(
    block: Block, rows: tuple[int, int], start: Lanes, step: Lanes, ends: tuple[float, float]
) -> Lanes:
    """Return each line's mean of what is left, e-, where `start + step j` lies between two ends.

    `rows` are the first of the pixels j that may lie there, and the last.
    """
    near, far, zero, unity = spread(ends[0]), spread(ends[1]), spread(0.0), spread(1.0)
    added, n_pixels = zero, zero
    for j in range(rows[0], rows[1] + 1):
        t = start + step * spread(j)
        counts = load(block.kind, j * N_LANES) == spread(COUNTS)
        counts = counts & (t >= near) & (t < far)
        added += where(counts, load(block.background, j * N_LANES), zero)
        n_pixels += where(counts, unity, zero)
    return added / n_pixels


@kernel(fastmath=REDUCTION)
def odd_parts(block: Block, n: int, fit: BlockFits, n_held: Lanes, width: Lanes, odd_e: Float32) -> None:
    """Write the odd residual (N_BINS, N_LANES), e-, of each line's fit, NaN where its window is too short.

    A bin's value is half the difference of the means at t and -t, t the place from the centre over the
    expected `width`; censored pixels count for nothing. `n_held` is each window's length. The block's
    background is lost.
    """
    _leave(block, n, fit)
    zero, part = spread(0.0), WINDOW_SIGMAS / N_BINS
    inverse = spread(1.0) / width
    start = zero - fit.position * inverse
    reach = spread((N_BINS - 1 + LAST_BIN) * part) * width
    is_seen = (fit.position >= reach) & (fit.position + reach <= n_held - spread(1.0))
    first, last = least(fit.position), -least(zero - fit.position)
    narrow, wide = least(width), -least(zero - width)
    for k in range(N_BINS):
        ends = k * part, (k + 1) * part
        ahead = max(int(first + ends[0] * narrow), 0), min(int(last + ends[1] * wide) + 1, n - 1)
        behind = max(int(first - ends[1] * wide), 0), min(int(last - ends[0] * narrow) + 1, n - 1)
        odd = _mean_between(block, ahead, start, inverse, ends)
        odd -= _mean_between(block, behind, zero - start, zero - inverse, ends)
        store(odd_e[k], 0, where(is_seen, spread(0.5) * odd, zero / zero))

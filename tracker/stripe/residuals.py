"""What sixteen scan lines' fits leave over: how it scatters about the bell, and what of it is odd."""

from __future__ import annotations

from noise_model.arrays import Float32
from noise_model.kernel import REDUCTION, kernel
from noise_model.lanes import N_LANES, Lanes, load, spread, store, where
from tracker.stripe.fit_block import WINDOW_SIGMAS, Fitted
from tracker.stripe.normal_equations import COUNTS, HIDDEN, Block, PixelNoise, bells

CORE_SIGMAS = 1.5
"""So near to a bell's middle its light is compared with a line's pixels."""

SATURATED_SIGMAS = 2.0
"""A line with a saturated pixel so near to its centre, in expected sigmas, is saturated."""

N_BINS = 4
"""Into so many parts of a side's window a line's odd residual is averaged."""

LAST_BIN = 0.5
"""A line whose window ends before this share of its last bin tells no odd residual."""


@kernel(fastmath=REDUCTION)
def core_square(block: Block, n: int, fit: Fitted, width: Lanes, noise: PixelNoise) -> tuple[Lanes, Lanes]:
    """Return the square of the contrast by which each line's pixels scatter about its bell, and if some hide.

    Within a line's core the residuals' squares are the photons' variance and the square of contrast times
    light; NaN of lines none of whose pixels there count. Hidden, 1 or 0, is whether a pixel within
    SATURATED_SIGMAS of the expected `width` is censored.
    """
    zero = spread(0.0)
    over, light, hidden = zero, zero, zero
    reach = spread(SATURATED_SIGMAS) * width
    inverse = spread(1.0) / fit.width
    for j in range(n):
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
def _leave(block: Block, n: int, fit: Fitted) -> None:
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
def odd_parts(block: Block, n: int, fit: Fitted, n_held: Lanes, width: Lanes, odd_e: Float32) -> None:
    """Write the odd residual (N_BINS, N_LANES), e-, of each line's fit, NaN where its window is too short.

    A bin's value is half the difference of the means at t and -t, t the place from the centre over the
    expected `width`; censored pixels count for nothing. `n_held` is each window's length. The block's
    background is lost.
    """
    _leave(block, n, fit)
    zero, unity, part = spread(0.0), spread(1.0), WINDOW_SIGMAS / N_BINS
    inverse = unity / width
    reach = spread((N_BINS - 1 + LAST_BIN) * part) * width
    is_seen = (fit.position >= reach) & (fit.position + reach <= n_held - unity)
    for k in range(N_BINS):
        near, far = spread(k * part), spread((k + 1) * part)
        after, behind, n_after, n_behind = zero, zero, zero, zero
        for j in range(n):
            t = (spread(j) - fit.position) * inverse
            counts = load(block.kind, j * N_LANES) == spread(COUNTS)
            is_after = counts & (t >= near) & (t < far)
            is_behind = counts & (zero - t >= near) & (zero - t < far)
            left_e = load(block.background, j * N_LANES)
            after += where(is_after, left_e, zero)
            n_after += where(is_after, unity, zero)
            behind += where(is_behind, left_e, zero)
            n_behind += where(is_behind, unity, zero)
        odd = spread(0.5) * (after / n_after - behind / n_behind)
        store(odd_e[k], 0, where(is_seen, odd, zero / zero))

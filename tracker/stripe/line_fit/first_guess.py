"""Input of sixteen scan lines' fits: their pixels, a lane a line, and a first guess."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float32
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import N_LANES, Lanes, load, root, spread, transpose, where
from tracker.stripe.line_fit.block import CORRELATION_PX, MIN_SIGMA_E, WINDOW_SIGMAS, LinePrior, larger
from tracker.stripe.line_fit.normal_equations import BEYOND, COUNTS, HIDDEN, Block

BLOCK = 8
"""A window is so many pixels, or a multiple."""

MAX_PIXELS = 512
"""No stripe's window is longer."""

PAD = N_LANES
"""Rows of 2^n bytes would share their place in the cache: each is longer by so many pixels."""

CORE_SIGMAS, CORE_MEAN = 0.5, 0.95
"""The first guess of an amplitude is from the pixels so near: a bell's mean there, over its top."""


class Rows(NamedTuple):
    """The pixels of sixteen windows, (N_LANES, MAX_PIXELS + PAD) each, line by line; see `Block`."""

    charge: Float32
    background: Float32
    kind: Float32


class Window(NamedTuple):
    """Sums over sixteen windows, by lane.

    `start`, `n` and `width` are `LinePrior`'s; `first` and `last` are the pixels that tell the amplitude,
    from the first to before the last; `edge` is by how much the map may be off for an edge nearby, e-. The
    pixels are means over a `share` of 1 line or 1/2 of two, and the square of `speckle` times their light
    varies.
    """

    start: Lanes
    n: Lanes
    width: Lanes
    first: Lanes
    last: Lanes
    edge: Lanes
    share: Lanes
    speckle: Lanes


class PixelVariance(NamedTuple):
    """A pixel's variance, and the background's own 1 sigma.

    The variance is `shot` (1, or 0 for one variance for all) times the pixel's mean plus `dark_e2`, and the
    square of `speckle`, of two lines' mean of `pair_speckle`, times the stripe's light. `map_rel` is the arc
    map's relative 1 sigma, `base_e` that of the black level and of the hall's light.
    """

    shot: float
    dark_e2: float
    map_rel: float
    base_e: float
    speckle: float = 0.0
    pair_speckle: float = 0.0


@kernel
def line_window(start: float, width: float, depth: int) -> tuple[int, int]:
    """Return from which pixel on and before which a line of so many pixels is read for a stripe at `start`.

    It is as many BLOCKs as hold WINDOW_SIGMAS on either side, two at least, moved where the line ends.
    """
    n = max(2, math.ceil(2.0 * WINDOW_SIGMAS * width / BLOCK)) * BLOCK
    low = max(0, min(math.ceil(start) - n // 2, depth - n))
    return low, min(low + n, depth)


@kernel
def core_of(place: float, width: float, n: int) -> tuple[int, int]:
    """Return from which pixel on and before which a window of n holds its stripe's first amplitude."""
    middle, core = round(place), int(CORE_SIGMAS * width) + 1
    return max(middle - core, 0), min(middle + core + 1, n)


@kernel
def _copy(pixels: Float32, row: Float32) -> None:
    """Copy a window's pixels (n,) into a row: a slice that is assigned to takes 2 s to compile."""
    for j in range(pixels.shape[0]):
        row[j] = pixels[j]


@kernel
def _kinds(censored: Bool, row: Float32) -> None:
    """Write the states of a window's pixels (n,) into a row."""
    for j in range(censored.shape[0]):
        row[j] = np.float32(HIDDEN) if censored[j] else np.float32(COUNTS)


@kernel
def take_line(charge: Float32, background: Float32, censored: Bool, lane: int, rows: Rows) -> None:
    """Copy a window's pixels (n,) into its row."""
    _copy(charge, rows.charge[lane])
    _copy(background, rows.background[lane])
    _kinds(censored, rows.kind[lane])


@kernel
def _means(line: Float32, next_line: Float32, row: Float32) -> None:
    """Write the means of two windows' pixels (n,) into a row."""
    for j in range(line.shape[0]):
        row[j] = np.float32(0.5) * (line[j] + next_line[j])


@kernel
def take_pair(charge: Float32, background: Float32, censored: Bool, lane: int, rows: Rows) -> None:
    """Write the means of two lines' pixels (2, n) into their row: what either hides is hidden."""
    _means(charge[0], charge[1], rows.charge[lane])
    _means(background[0], background[1], rows.background[lane])
    for j in range(censored.shape[1]):
        is_hidden = censored[0, j] or censored[1, j]
        rows.kind[lane, j] = np.float32(HIDDEN) if is_hidden else np.float32(COUNTS)


@kernel
def leave_out(lane: int, first: int, last: int, rows: Rows) -> None:
    """Make a row's pixels from the first to before the last count for nothing."""
    for j in range(first, last):
        rows.charge[lane, j], rows.background[lane, j], rows.kind[lane, j] = 0.0, 0.0, BEYOND


@kernel
def write_block(rows: Rows, n: int, block: Block) -> None:
    """Write the first n pixels of all rows, and up to N_LANES - 1 more, into a block."""
    for j in range(0, n, N_LANES):
        transpose(rows.charge, j, block.charge)
        transpose(rows.background, j, block.background)
        transpose(rows.kind, j, block.kind)


@kernel(fastmath=REDUCTION)
def first_guess(block: Block, n: int, asked: Window, noise: PixelVariance) -> LinePrior:
    """Return the fits' input for lines whose first n pixels a block holds; NaN where a line's map is."""
    zero, unity = spread(0.0), spread(1.0)
    level, over = zero, zero
    for j in range(n):
        background, here = load(block.background, j * N_LANES), spread(j)
        level += background
        is_core = (here >= asked.first) & (here < asked.last)
        over += where(is_core, load(block.charge, j * N_LANES) - background, zero)
    level /= asked.n
    over /= (asked.last - asked.first) * spread(CORE_MEAN)
    off = spread(noise.map_rel) * level
    smooth = larger(root(off * off + spread(noise.base_e**2)), spread(MIN_SIGMA_E))
    slope, bent = smooth / spread(CORRELATION_PX), asked.edge / (spread(WINDOW_SIGMAS) * asked.width)
    return LinePrior(
        asked.start,
        asked.n,
        asked.width,
        larger(over, unity),
        level,
        unity / (smooth * smooth + asked.edge * asked.edge),
        unity / (slope * slope + bent * bent),
    )

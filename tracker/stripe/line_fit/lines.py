"""The maximum-likelihood centre of a stripe in a scan line, under arc light.

Along a scan line the charge is d(r) = A exp(-1/2 ((r - r_0)/w)^2) + L m(r) + b_0 + b_1 (r - r_0) + noise, m
the arc map, with the variance of a pixel at its *fitted* mean (never the observed one: that would favour
dark pixels). b_0 and b_1 are what the map may be wrong by, with a prior from its stated uncertainty; ln w has
one from the stripe that the setup predicts. A saturated pixel is censored: it says no more than 'at least
this', so it pulls only where the model lies below it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.lanes import N_LANES, load, spread, store, where
from tracker.stripe.line_fit.block import ROUNDS, BlockFits, FitState, first_state, fit_block
from tracker.stripe.line_fit.first_guess import (
    MAX_PIXELS,
    PAD,
    PixelVariance,
    Rows,
    Window,
    core_of,
    first_guess,
    leave_out,
    line_window,
    take_line,
    take_pair,
    write_block,
)
from tracker.stripe.line_fit.normal_equations import Block, PixelNoise
from tracker.stripe.line_fit.residuals import N_BINS, core_square, odd_parts

N_FITTED = 7
"""A line's fit has so many numbers."""

N_WINDOW, N_STATE, N_WRITTEN = len(Window._fields), len(FitState._fields), N_FITTED + 5 + N_BINS
"""Numbers of a lane that go into its fit, hold its state, and come out: with three answers, and with
what the fit leaves."""

EDGE_PX = 3
"""Error of the map's edges, in scan lines: hand-eye and the seam's direction."""


class FitRoom(NamedTuple):
    """Room for the fit of sixteen lines, and for what a frame's lines are fitted by.

    `windows` (3, N_LANES, n) and `block` (3, n N_LANES) hold charge, background and kind of their pixels line
    by line, and pixel by pixel. `lanes` (N_WINDOW + N_STATE + N_WRITTEN, N_LANES) hold their numbers,
    `places` (2, N_LANES) which lines they are and where their windows begin. The first of `todo` (n_scan,)
    are the lines that are still to be fitted, and `states` (n_scan, N_STATE) is where their fits stand.
    """

    windows: Float32
    block: Float32
    lanes: Float32
    places: Int64
    todo: Int64
    states: Float32


def fit_room(n_scan: int) -> FitRoom:
    """Make room for the fits of a frame's lines."""
    return FitRoom(
        windows=np.empty((3, N_LANES, MAX_PIXELS + PAD), np.float32),
        block=np.empty((3, (MAX_PIXELS + PAD) * N_LANES), np.float32),
        lanes=np.empty((N_WINDOW + N_STATE + N_WRITTEN, N_LANES), np.float32),
        places=np.zeros((2, N_LANES), np.int64),
        todo=np.empty(n_scan, np.int64),
        states=np.empty((n_scan, N_STATE), np.float32),
    )


class Scans(NamedTuple):
    """Light that lines are fitted to.

    `charge`, `background` (n_scan, depth) are the linearised pixels and the arc map at its level, e-, of a
    band that begins at `lows`. Each line's fit begins at `start` (n_scan,), NaN for none, with a stripe of
    1 sigma `width`, px. Where `n_lines` (n_scan,) is 2, a line and the next are fitted as one, to the mean of
    their pixels.
    """

    charge: Float32
    background: Float32
    censored: Bool
    start: Float64
    width: Float64
    n_lines: Float64
    lows: Int64


class LineFits(NamedTuple):
    """The fits of all scan lines, written over in each frame.

    `tried` (n_scan, N_FITTED) are all fits that came to their end: position, sigma, amplitude, width, chi2,
    and the background's offset b_0 and slope b_1. `fits` (n_scan, N_FITTED) are those that hold a stripe; NaN
    in the others. Of these `core` (n_scan,) is `residuals.core_square` and `odd` (n_scan, N_BINS) are
    `residuals.odd_parts`.
    """

    tried: Float64
    fits: Float64
    core: Float32
    odd: Float64
    saturated: Bool

    @classmethod
    def empty(cls, n_scan: int) -> LineFits:
        """Make room for the lines of a frame."""
        tried, fits = np.empty((2, n_scan, N_FITTED))
        odd, core = np.empty((n_scan, N_BINS)), np.empty(n_scan, np.float32)
        return cls(tried, fits, core, odd, np.empty(n_scan, np.bool_))


@kernel
def map_edge(background: Float32, lows: Int64, s: int, position: float) -> float:
    """Return the change of the map, e-, over EDGE_PX scan lines to either side at a position."""
    n_scan, depth = background.shape
    middle = background[s, min(max(int(position) - lows[s // CELL], 0), depth - 1)]
    change = 0.0
    for other in (s - EDGE_PX, s + EDGE_PX):
        if 0 <= other < n_scan:
            r = min(max(int(position) - lows[other // CELL], 0), depth - 1)
            if not math.isnan(background[other, r]):
                change = max(change, abs(background[other, r] - middle))
    return change


@kernel
def _fill_up(n_lanes: int, n_pixels: int, window: Float32, rows: Rows) -> None:
    """Make what lies beyond a line's end count for nothing, and lanes without a line follow the first."""
    end = -(-n_pixels // N_LANES) * N_LANES
    for lane in range(N_LANES):
        if lane < n_lanes:
            leave_out(lane, int(window[1, lane]), end, rows)
        else:
            leave_out(lane, 0, end, rows)
            for k in range(N_WINDOW):
                window[k, lane] = window[k, 0]


@kernel
def _load_state(state: Float32) -> FitState:
    """Return the state of the lanes' fits."""
    return FitState(
        load(state[0], 0),
        load(state[1], 0),
        load(state[2], 0),
        load(state[3], 0),
        load(state[4], 0),
        load(state[5], 0),
        load(state[6], 0),
    )


@kernel
def _store_state(reached: FitState, state: Float32) -> None:
    """Write the state of the lanes' fits."""
    store(state[0], 0, reached.amplitude)
    store(state[1], 0, reached.position)
    store(state[2], 0, reached.width)
    store(state[3], 0, reached.off)
    store(state[4], 0, reached.offset)
    store(state[5], 0, reached.slope)
    store(state[6], 0, reached.is_settled)


@kernel
def _write_fit(fit: BlockFits, fitted: Float32) -> None:
    """Write the fits, and which are done and hold a stripe."""
    store(fitted[0], 0, fit.position)
    store(fitted[1], 0, fit.sigma)
    store(fitted[2], 0, fit.amplitude)
    store(fitted[3], 0, fit.width)
    store(fitted[4], 0, fit.chi2)
    store(fitted[5], 0, fit.offset)
    store(fitted[6], 0, fit.slope)
    store(fitted[N_FITTED], 0, where(fit.is_done, spread(1.0), spread(0.0)))
    store(fitted[N_FITTED + 1], 0, where(fit.is_stripe, spread(1.0), spread(0.0)))


@kernel
def _fit_lanes(
    n_lanes: int, n_pixels: int, noise: PixelVariance, turn: int, n_left: int, room: FitRoom, lines: LineFits
) -> int:
    """Fit the lines in the first lanes and write what their fits say; return how many lines are left now."""
    window, state = room.lanes[:N_WINDOW], room.lanes[N_WINDOW : N_WINDOW + N_STATE]
    fitted, block = room.lanes[N_WINDOW + N_STATE :], Block(room.block[0], room.block[1], room.block[2])
    rows = Rows(room.windows[0], room.windows[1], room.windows[2])
    _fill_up(n_lanes, n_pixels, window, rows)
    write_block(rows, n_pixels, block)
    asked = Window(
        start=load(window[0], 0),
        n=load(window[1], 0),
        width=load(window[2], 0),
        first=load(window[3], 0),
        last=load(window[4], 0),
        edge=load(window[5], 0),
        share=load(window[6], 0),
        speckle=load(window[7], 0),
    )
    pixel_noise = PixelNoise(
        spread(noise.shot) * asked.share, spread(noise.dark_e2) * asked.share, asked.speckle
    )
    known = first_guess(block, n_pixels, asked, noise)
    reached = first_state(known)
    if turn > 0:
        for lane in range(n_lanes):
            for k in range(N_STATE):
                state[k, lane] = room.states[room.places[0, lane], k]
        reached = _load_state(state)
    fit, reached, goes_on = fit_block(block, n_pixels, known, pixel_noise, reached, turn == ROUNDS - 1)
    _write_fit(fit, fitted)
    _store_state(reached, state)
    core, hidden = core_square(block, n_pixels, fit, asked.width, pixel_noise)
    store(fitted[N_FITTED + 2], 0, core)
    store(fitted[N_FITTED + 3], 0, hidden)
    store(fitted[N_FITTED + 4], 0, where(goes_on, spread(1.0), spread(0.0)))
    odd_parts(block, n_pixels, fit, asked.n, asked.width, fitted[N_FITTED + 5 :])
    for lane in range(n_lanes):
        line = room.places[0, lane]
        if fitted[N_FITTED, lane] > 0.0:
            for k in range(N_FITTED):
                lines.tried[line, k] = fitted[k, lane]
            lines.tried[line, 0] += room.places[1, lane]
        if fitted[N_FITTED + 1, lane] > 0.0:
            for k in range(N_FITTED):
                lines.fits[line, k] = lines.tried[line, k]
            lines.core[line] = fitted[N_FITTED + 2, lane]
            for k in range(N_BINS):
                lines.odd[line, k] = fitted[N_FITTED + 5 + k, lane]
            lines.saturated[line] = fitted[N_FITTED + 3, lane] > 0.0
        if fitted[N_FITTED + 4, lane] > 0.0:
            room.todo[n_left] = line
            n_left += 1
            for k in range(N_STATE):
                room.states[line, k] = state[k, lane]
    return n_left


@kernel
def _fit_round(
    scans: Scans, noise: PixelVariance, turn: int, n_todo: int, room: FitRoom, lines: LineFits
) -> int:
    """Take a round of steps on the lines to be fitted; return how many are left."""
    depth, asked = scans.charge.shape[1], room.lanes
    rows = Rows(room.windows[0], room.windows[1], room.windows[2])
    lane, longest, n_left = 0, 0, 0
    for i in range(n_todo):
        s = room.todo[i]
        start, width, begin = scans.start[s], scans.width[s], scans.lows[s // CELL]
        is_pair = scans.n_lines[s] > 1
        if is_pair:
            start = 0.5 * (start + scans.start[s + 1])
        place = start - begin
        low, end = line_window(place, width, depth)
        n = end - low
        if n <= 2.0 * width or n > MAX_PIXELS or not low < round(place) < end - 1:
            continue
        if is_pair:
            both = slice(s, s + 2), slice(low, end)
            take_pair(scans.charge[both], scans.background[both], scans.censored[both], lane, rows)
        else:
            take_line(
                scans.charge[s, low:end], scans.background[s, low:end], scans.censored[s, low:end], lane, rows
            )
        asked[0, lane], asked[1, lane], asked[2, lane] = place - low, n, width
        asked[3, lane], asked[4, lane] = core_of(place - low, width, n)
        asked[5, lane] = map_edge(scans.background, scans.lows, s, start)
        asked[6, lane] = 0.5 if is_pair else 1.0
        asked[7, lane] = noise.pair_speckle if is_pair else noise.speckle
        room.places[0, lane], room.places[1, lane] = s, begin + low
        lane, longest = lane + 1, max(longest, n)
        if lane == N_LANES:
            n_left = _fit_lanes(lane, longest, noise, turn, n_left, room, lines)
            lane, longest = 0, 0
    if lane > 0:
        n_left = _fit_lanes(lane, longest, noise, turn, n_left, room, lines)
    return n_left


@kernel
def fit_lines(scans: Scans, noise: PixelVariance, room: FitRoom, lines: LineFits) -> None:
    """Fit every scan line that has a start, and write what the fits say; of a pair in the first of both.

    How much the map changes to the neighbouring lines counts as well: an edge may cut across a line.
    """
    n_todo, n_scan = 0, scans.charge.shape[0]
    for s in range(n_scan):
        lines.saturated[s], lines.core[s] = False, np.float32(math.nan)
        for k in range(N_FITTED):
            lines.tried[s, k] = lines.fits[s, k] = math.nan
        for k in range(N_BINS):
            lines.odd[s, k] = math.nan
        is_second = scans.n_lines[s] > 1 and s % 2 == 1
        if not (math.isnan(scans.start[s]) or is_second):
            room.todo[n_todo] = s
            n_todo += 1
    for turn in range(ROUNDS):
        n_todo = _fit_round(scans, noise, turn, n_todo, room, lines)

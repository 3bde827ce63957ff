"""The stripe on a board, from an image with the laser off and one with the laser on.

Room light cancels in the difference. A matched filter and the tracker's likeliest path say where the stripe
may be, along rows or along columns. A flat board's stripe is straight but for the lens: most of those places
agree on a line, and all scan lines are then looked at near it. The place in each is the centroid of its light
under a Gaussian of the stripe's width: the matched filter's maximum.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from skimage.measure import LineModelND, ransac

from calibration.boards.board import Board
from calibration.camera.lens import Lens
from calibration.laser.matched_scales import SCALES_PX, smoothed_by_scale
from noise_model.compiled.arrays import Bool, Float32, Float64, Int64, Integers
from noise_model.robust import spread
from noise_model.transforms import transform
from tracker.stripe.viterbi import GAIN_CAP, JUMP_COST, best_path

MIN_SCORE = 6.0
"""Least output of the matched filter, in its sigmas, where a scan line shows the stripe."""

MIN_LINES = 20
"""Least number of scan lines with a stripe that determine a direction."""

REACH = 3.0
"""Half-width of the stripe's window, in sigmas."""

MAX_STEPS, SETTLED_PX = 60, 1e-4
"""Steps of the centroid at most, and the one that is the last."""

MARGIN = 0.9
"""Extent of the board beyond its outer corners, in squares."""

TRIALS, SEED = 500, 1
"""Pairs of places through which RANSAC lays a line at most, and the seed of its choice."""

BEND_PX = 3.0
"""Largest bend of a line by a lens within the board."""

TRIM_ROUNDS, TRIM_SIGMAS, MIN_TRIM_PX = 8, 4.0, 0.3
"""Rounds of trimming, and the distance from the stripe's curve, in sigmas and px, of a trimmed place."""

GAP_LINES, MIN_PIECE_SHARE, MIN_SHARE = 10, 0.2, 0.08
"""Gap of lines between pieces of a stripe, and the share of the longest, or of all, below which a piece is
dropped.
"""

NOISE_FLOOR_DN = 0.3
"""Rounding of two images leaves that much noise at least."""


@dataclass(frozen=True)
class BoardStripe:
    """A stripe in an image: `points_px` (n, 2), one for each scan line.

    With `along_rows` scan lines are columns; `scale_px` is the stripe's sigma with the best contrast.
    """

    points_px: Float64
    along_rows: bool
    scale_px: float


def board_area(board: Board, lens: Lens, T_camera_board: Float64) -> Bool:
    """Return the mask (H, W) of the board, its outer squares included."""
    low, high = -MARGIN * board.square_mm, np.array([board.columns, board.rows]) - 1.0 + MARGIN
    # Ten points on each side: a lens may bend it.
    (x1, y1), step = high * board.square_mm, np.linspace(0.0, 1.0, 10, endpoint=False)
    corners = np.array([[low, low, 0.0], [x1, low, 0.0], [x1, y1, 0.0], [low, y1, 0.0]])
    sides = corners[:, np.newaxis] + step[:, np.newaxis] * (np.roll(corners, -1, axis=0) - corners)[:, None]
    outline = transform(T_camera_board, sides.reshape(-1, 3))
    drawn = np.zeros((lens.height, lens.width), dtype=np.uint8)
    reach = 4 * max(drawn.shape)
    cv2.fillPoly(drawn, [lens.project(outline).clip(-reach, reach).round().astype(np.int32)], 1)
    return np.asarray(drawn > 0)


@dataclass(frozen=True)
class LaserLight:
    """The laser's light on a board; arrays are (H, W).

    `light_dn` is the image with the laser less that without, 0 outside the board, `noise_dn` its 1 sigma
    without a stripe, `area` the board's pixels.
    """

    light_dn: Float32
    noise_dn: Float32
    area: Bool


def laser_light(off_dn: Integers, on_dn: Integers, area: Bool) -> LaserLight:
    """Return the laser's light on a board, from images (H, W) without and with it.

    Lamps flicker: on = gain off + offset is fitted to the board's pixels, without what the laser lights.
    """
    off, on = (image[area].astype(np.float64) for image in (off_dn, on_dn))
    kept = np.ones(len(off), dtype=bool)
    gain, offset = 1.0, 0.0
    for _ in range(4):
        if not np.ptp(off[kept]) > 0.0:
            break
        gain, offset = np.polyfit(off[kept], on[kept], 1)
        rest = on - gain * off - offset
        middle = float(np.median(rest))
        kept = np.abs(rest - middle) <= 3.0 * max(spread(rest), 1.0)
    light = np.zeros(off_dn.shape, dtype=np.float32)
    rest = on - gain * off - offset
    light[area] = rest
    # Bright squares have more shot noise, and more of what a codec leaves.
    # The difference's noise is measured in four parts of the board, from dark to bright.
    n_parts = 4
    limits = np.quantile(off, np.linspace(0.0, 1.0, n_parts + 1)[1:-1])
    part = np.searchsorted(limits, off)
    spreads = [spread(rest[part == n]) for n in range(n_parts)]
    noise = np.ones(off_dn.shape, dtype=np.float32)
    noise[area] = np.maximum(spreads, NOISE_FLOOR_DN)[part]
    return LaserLight(light, noise, area)


def find_stripe(seen: LaserLight) -> BoardStripe | None:
    """Return the stripe on a board along the direction in which it is clearer; None without one."""
    rows, columns = (np.flatnonzero(seen.area.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    light, noise, area = seen.light_dn[box], seen.noise_dn[box], seen.area[box]
    stripe = _clearer(_along, LaserLight(light, noise, area))
    if stripe is None:
        return None
    return replace(stripe, points_px=stripe.points_px + np.array([columns[0], rows[0]]))


def likeliest_path(seen: LaserLight) -> BoardStripe | None:
    """Return the stripe whatever its course, corners and steps included; None without one.

    It has a point in each scan line that shows it, along the direction in which it is clearer.
    """
    return _clearer(_path, seen)


@dataclass(frozen=True)
class _Track:
    """A stripe across scan lines (n,): how clear it is in all, its places (n,), and its sigma, px."""

    clearness: float
    scan: Int64
    places: Float64
    scale_px: float


def _clearer(track: Callable[[Float32, Float32, Bool], _Track], seen: LaserLight) -> BoardStripe | None:
    """Return the stripe along the direction in which it is tracked more clearly; None without one."""
    light, noise, area = seen.light_dn, seen.noise_dn, seen.area
    both = [track(np.ascontiguousarray(light.T), noise.T, area.T), track(light, noise, area)]
    along_rows = both[0].clearness >= both[1].clearness
    best = both[0] if along_rows else both[1]
    if len(best.scan) < MIN_LINES:
        return None
    pair = [best.scan, best.places] if along_rows else [best.places, best.scan]
    return BoardStripe(np.column_stack(pair), along_rows, best.scale_px)


def _likely(score: Float32) -> tuple[Int64, Int64]:
    """Return the scan lines (k,) in which the likeliest path is clear, and its places there (k,)."""
    choice = np.empty(len(score), dtype=np.int64)
    best_path(score, JUMP_COST, choice)
    scan = np.flatnonzero(choice >= 0)
    scan = scan[score[scan, choice[scan]] >= MIN_SCORE]
    return scan, choice[scan]


def _along(lines: Float32, noise: Float32, inside: Bool) -> _Track:
    """Return the straightest of the likely stripes across scan lines (n, m)."""
    score, sigma = _match_filters(lines, noise, inside)
    nothing = _Track(0.0, np.empty(0, dtype=np.int64), np.empty(0), sigma)
    scan, place = _likely(score)
    if len(scan) < MIN_LINES:
        return nothing
    points, near_px = np.column_stack([scan, place]), BEND_PX + 2.0 * sigma
    _, agreed = ransac(points, LineModelND, 2, near_px, max_trials=TRIALS, rng=SEED)  # type: ignore[no-untyped-call]
    if agreed is None or agreed.sum() < MIN_LINES:
        return nothing
    # A bent line: twice, as the first time only those near a straight one count.
    for _ in range(2):
        course = np.polynomial.Polynomial.fit(scan[agreed], place[agreed], 2)
        agreed = np.abs(place - course(scan)) <= 2.0 * sigma + 1.0
        if agreed.sum() < MIN_LINES:
            return nothing
    near = np.arange(scan[agreed].min(), scan[agreed].max() + 1)
    start = course(near)
    places, settled = _centroids(lines[near], start, sigma)
    reach = REACH * sigma
    settled &= (places > reach) & (places < lines.shape[1] - 1 - reach)
    near, places, start = near[settled], places[settled], start[settled]
    clear = score[near, places.round().astype(np.int64)]
    kept = (clear >= MIN_SCORE) & (np.abs(places - start) <= 2.0 * sigma + 1.0)
    kept = _on_one_curve(near, places, kept)
    return _Track(float(np.minimum(0.5 * clear[kept] ** 2, GAIN_CAP).sum()), near[kept], places[kept], sigma)


def _path(lines: Float32, noise: Float32, inside: Bool) -> _Track:
    """Return the likeliest path across scan lines (n, m), where it is clear."""
    score, sigma = _match_filters(lines, noise, inside)
    scan, place = _likely(score)
    start = place.astype(np.float64)
    places, settled = _centroids(lines[scan], start, sigma)
    settled &= np.abs(places - start) <= 2.0 * sigma + 1.0
    clear = score[scan, place][settled]
    clearness = float(np.minimum(0.5 * clear**2, GAIN_CAP).sum())
    return _Track(clearness, scan[settled], places[settled], sigma)


def _on_one_curve(scan: Int64, places: Float64, clear: Bool) -> Bool:
    """Return the clear places (n,) on the stripe's parabola: a board's edges cross it."""
    kept = _without_scraps(scan, clear)
    for _ in range(TRIM_ROUNDS):
        if kept.sum() < MIN_LINES:
            return kept
        off = places - np.polynomial.Polynomial.fit(scan[kept], places[kept], 2)(scan)
        near = np.abs(off) <= max(TRIM_SIGMAS * spread(off[kept]), MIN_TRIM_PX)
        kept = _without_scraps(scan, clear & near)
    return kept


def _without_scraps(scan: Int64, kept: Bool) -> Bool:
    """Return those kept (n,) that are in long pieces of the stripe."""
    where = np.flatnonzero(kept)
    piece = np.cumsum(np.diff(scan[where], prepend=scan[where[:1]]) > GAP_LINES)
    counts = np.bincount(piece)
    long = np.zeros(len(kept), dtype=bool)
    min_count = max(MIN_PIECE_SHARE * counts.max(initial=0), MIN_SHARE * len(where))
    long[where[counts[piece] >= min_count]] = True
    return long


def _match_filters(lines: Float32, noise: Float32, inside: Bool) -> tuple[Float32, float]:
    """Return the matched filter's output in its sigmas (n, m), of the stripe's sigma that shows most."""
    best, best_score = (-np.inf, SCALES_PX[0]), np.zeros_like(lines)
    for sigma, near, wide in smoothed_by_scale(lines):
        output = (near - wide) / noise
        # The output's own spread says how much noise is left, whatever a codec has made of it.
        score = np.where(inside, output / max(spread(output[inside]), 1e-6), 0.0).astype(np.float32)
        shows = float(score.max(axis=1).mean())
        if shows > best[0]:
            best, best_score = (shows, sigma), score
    return best_score, best[1]


def _centroids(lines: Float32, start_px: Float64, sigma_px: float) -> tuple[Float64, Bool]:
    """Return the centroid of each line's light (n,) under a Gaussian about itself, and whether it settled."""
    half = int(np.ceil(REACH * sigma_px)) + 2
    first = np.rint(start_px).astype(np.int64) - half
    offsets = first[:, np.newaxis] + np.arange(2 * half + 1)
    light = np.take_along_axis(lines, offsets.clip(0, lines.shape[1] - 1), axis=1)
    place = start_px.copy()
    step = np.full(len(place), np.inf)
    for _ in range(MAX_STEPS):
        weight = light * np.exp(-0.5 * ((offsets - place[:, np.newaxis]) / sigma_px) ** 2)
        total = weight.sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(total > 0.0, (weight * offsets).sum(axis=1) / total - place, np.nan)
        place = np.where(np.isfinite(step), place + step, place)
        if not np.nanmax(np.abs(step), initial=0.0) > SETTLED_PX:
            break
    near = np.abs(place - start_px) <= REACH * sigma_px
    return place, near & (np.abs(np.nan_to_num(step, nan=np.inf)) < 0.01)

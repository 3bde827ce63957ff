"""Detection of a board's corners in an image.

OpenCV finds the board, on the image as it is, inverted, stretched and equalised: a board may be light on
dark, dim, or unevenly lit. The corners are then located on the raw image, with unchanged grey levels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from calibration.boards.board import Board, BoardKind
from noise_model.compiled.arrays import Float32, Float64, Int64, Integers, UInt8

WINDOW = 0.15
"""Half the side of the window that places a corner, over the distance to its neighbour."""

MARKER_CLEARANCE = 0.9
"""Largest share of the gap between a corner and its next marker that the window takes."""

MIN_WINDOW_PX = 2
MIN_PITCH_PX = 2.0 * MIN_WINDOW_PX
"""Corners that are nearer to each other have their neighbours in their windows."""

MIN_CORNERS = 6
"""Least number of corners that determine more than the board's pose."""

MIN_CONTRAST = 1.0
"""Light squares less dark ones, over the scatter of either: less is no board."""


@dataclass(frozen=True)
class Corners:
    """A board's corners in an image.

    `corners` (n,) are their numbers on the board, `points_px` (n, 2) their positions, pixel centres at
    integers; `contrast_dn` is the light squares' level over the dark ones'.
    """

    corners: Int64
    points_px: Float64
    contrast_dn: float


def find_corners(image_dn: Integers, board: Board) -> Corners | None:
    """Find a board in an image (H, W) of 8 or 16 bits; None without a board.

    Of a chessboard all corners are returned, of a ChArUco board those that can be identified.
    """
    raw = image_dn.astype(np.float32)
    for corners, points in _candidates(image_dn, board):
        result = _refine_corners(raw, board, corners, points)
        if result is not None:
            return result
    return None


def small_pitch_px(image_dn: Integers, board: Board) -> float | None:
    """Return the least distance of corners, px, of a board that is seen too small; None if none is seen."""
    for corners, points in _candidates(image_dn, board):
        pitch = _pitch_px(_grid(board, corners, points))
        if pitch <= MIN_PITCH_PX:
            return pitch
    return None


def _candidates(image_dn: Integers, board: Board) -> Iterator[tuple[Int64, Float64]]:
    """Yield corners and roughly their points (n, 2), px, each time that a scale shows the board."""
    # A larger image is searched at a smaller scale first: squares are then no more than some 100 px wide.
    searched_px = 1200
    first = min(1.0, searched_px / max(image_dn.shape))
    # OpenCV finds no squares of a few pixels.
    enlarged = min(4.0, max(1.0, searched_px / max(image_dn.shape)))
    for scale in sorted({first, 1.0, enlarged}):
        for picture in _pictures(image_dn, scale):
            place = _search(picture, board, is_again=scale > first)
            if place is not None:
                corners, points = place
                yield corners, (points + 0.5) / scale - 0.5


def _pictures(image_dn: Integers, scale: float) -> Iterator[UInt8]:
    """Yield the image in 8 bits, in the ways in which boards are sought in it."""
    # Neither a glint nor a dead pixel sets black or white.
    low, high = np.percentile(image_dn, (0.5, 99.5))
    if not high > low:
        return
    stretched = np.clip((image_dn - low) * (255.0 / (high - low)), 0.0, 255.0).astype(np.uint8)
    plain = image_dn if image_dn.dtype == np.uint8 else stretched
    # CLAHE evens out light that changes over the image.
    evened = cv2.createCLAHE(4.0, (8, 8)).apply(stretched)
    for picture in (plain, stretched, evened):
        small = np.asarray(picture, dtype=np.uint8)
        if scale != 1.0:
            size = round(scale * picture.shape[1]), round(scale * picture.shape[0])
            way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
            small = np.asarray(cv2.resize(small, size, interpolation=way))
        yield small
        yield 255 - small


def _search(picture: UInt8, board: Board, *, is_again: bool) -> tuple[Int64, Float64] | None:
    if board.kind is BoardKind.CHARUCO:
        return _search_charuco(picture, board)
    size, flags = (board.columns, board.rows), cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    if is_again:
        # A large image without a board may have enough texture for a whole search to take a minute.
        flags |= cv2.CALIB_CB_FAST_CHECK
    ok, points = cv2.findChessboardCorners(picture, size, flags=flags)
    if not ok:
        return None
    return np.arange(board.columns * board.rows), np.asarray(points, dtype=np.float64)[:, 0]


def _search_charuco(picture: UInt8, board: Board) -> tuple[Int64, Float64] | None:
    best: tuple[Int64, Float64] | None = None
    # Boards of an even number of rows begin with another colour since OpenCV 4.6.
    for is_legacy in (False, True):
        points, ids, _, _ = _detector(board, is_legacy).detectBoard(picture)
        if ids is not None and len(ids) >= MIN_CORNERS and (best is None or len(ids) > len(best[0])):
            best = ids.ravel().astype(np.int64), points.reshape(-1, 2).astype(np.float64)
    return best


@cache
def _detector(board: Board, is_legacy: bool) -> cv2.aruco.CharucoDetector:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    squares = board.columns + 1, board.rows + 1
    pattern = cv2.aruco.CharucoBoard(squares, board.square_mm, board.marker_mm, dictionary)
    pattern.setLegacyPattern(is_legacy)
    detector = cv2.aruco.CharucoDetector(pattern)
    parameters = cv2.aruco.DetectorParameters()
    parameters.detectInvertedMarker = True
    detector.setDetectorParameters(parameters)
    return detector


def _refine_corners(raw: Float32, board: Board, corners: Int64, points_px: Float64) -> Corners | None:
    """Return corners placed on the raw image and in the board's order, None if they are those of no board."""
    whole = _grid(board, corners, points_px)
    grid, pitch = whole.reshape(-1, 2), _pitch_px(whole)
    if not pitch > MIN_PITCH_PX:
        return None
    # The first window is wider, for corners that were found at a smaller scale.
    for window in (0.25, WINDOW):
        half = window * pitch
        if board.kind is BoardKind.CHARUCO:
            gap = 0.5 * (1.0 - board.marker_mm / board.square_mm) * pitch
            half = min(half, MARKER_CLEARANCE * gap)
        half = max(round(half), MIN_WINDOW_PX)
        start = grid[corners].astype(np.float32).reshape(-1, 1, 2)
        grid[corners] = cv2.cornerSubPix(
            raw, start, (half, half), (-1, -1), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
        )[:, 0]
    if _handedness(whole) < 0.0:
        if board.kind is BoardKind.CHARUCO:
            return None
        # A board is not seen from behind.
        whole = whole[:, ::-1]
    inward = (
        1.0
        if board.kind is BoardKind.CHESSBOARD
        else MARKER_CLEARANCE * (1.0 - board.marker_mm / board.square_mm)
    )
    contrast, scatter = _contrast(raw, whole, inward)
    if not abs(contrast) > MIN_CONTRAST * scatter:
        return None
    if board.kind is BoardKind.CHESSBOARD and contrast < 0.0 and (board.rows + board.columns) % 2:
        # Turned by half a turn, such a board has its colours the other way round: that tells its ends apart.
        whole = whole[::-1, ::-1]
    flat = whole.reshape(-1, 2)
    seen = np.flatnonzero(np.isfinite(flat[:, 0]))
    return Corners(seen, flat[seen], abs(contrast))


def _grid(board: Board, corners: Int64, points_px: Float64) -> Float64:
    """Return the points (rows, columns, 2), px, NaN for corners that are not seen."""
    grid = np.full((board.rows * board.columns, 2), np.nan)
    grid[corners] = points_px
    return grid.reshape(board.rows, board.columns, 2)


def _pitch_px(grid: Float64) -> float:
    """Return the least distance of neighbours on a board (rows, columns, 2), px; NaN without neighbours."""
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    known = np.concatenate(steps)
    known = known[np.isfinite(known)]
    return float(known.min()) if len(known) else float("nan")


def _handedness(grid: Float64) -> float:
    """Return a number above 0 if rows follow columns as y follows x."""
    along, down = (np.diff(grid, axis=axis) for axis in (1, 0))
    a, b = along[:-1], down[:, :-1]
    return float(np.nansum(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]))


def _contrast(raw: Float32, grid: Float64, inward: float) -> tuple[float, float]:
    """Return the grey levels of squares of one colour less those of the other, and their scatter, DN.

    A square's level is the mean of four places, so far from each corner to the middle: markers fill the rest.
    """
    ends = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[:-1, 1:], grid[1:, 1:]])
    middles = ends.mean(axis=0)
    places = (1.0 - inward) * ends + inward * middles
    x, y = (np.ascontiguousarray(places[..., n].reshape(-1, ends.shape[2]), dtype=np.float32) for n in (0, 1))
    sampled = np.asarray(cv2.remap(raw, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    level = sampled.reshape(ends.shape[:3]).mean(axis=0)
    is_first = np.add.outer(np.arange(len(level)), np.arange(level.shape[1])) % 2 == 0
    known = np.isfinite(middles[..., 0])
    first, second = level[known & is_first], level[known & ~is_first]
    if not (len(first) and len(second)):
        return float("nan"), float("nan")
    scatter = max(float(np.std(first)), float(np.std(second)))
    return float(np.median(first) - np.median(second)), scatter

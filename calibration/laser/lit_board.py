"""Separation of a lit board and the stripe in one image: the board's own picture is subtracted.

The board's pose says which square, and which marker, each pixel sees. Their light and dark are two smooth
fields of room light, fitted to the pixels that the laser does not light.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.boards.board import Board, BoardKind
from calibration.camera.lens import Lens
from calibration.laser.plane import points_on_board
from calibration.laser.stripe import NOISE_FLOOR_DN, LaserLight, board_area
from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.robust import spread

SAMPLES = 3
"""Samples a pixel along each axis: squares' edges run through pixels."""

ROUNDS, TRIM_SIGMAS = 8, 3.0
"""Rounds by which room light is fitted, and beyond how many sigmas a pixel does not count in them."""

MAX_PIXELS = 40_000
"""Approximate number of pixels that room light is fitted to."""

EDGE_SHARE = 0.02
"""Pixels whose blurred board changes by more than that share from light to dark per px are at an edge."""

CELL_PX = 32
"""The side of a marker's square in OpenCV's drawing of a board, px."""


def board_shading(
    board: Board, lens: Lens, T_camera_board: Float64, blur_px: float, *, is_legacy: bool = False
) -> Float64:
    """Return a board's reflectance at each pixel (H, W), 1 for white and 0 for black; NaN outside of it.

    The dark squares of a chessboard are unknown: light and dark may change places.
    """
    area = board_area(board, lens, T_camera_board)
    shading = np.full(area.shape, np.nan)
    rows, columns = np.nonzero(area)
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    # Rays are smooth: those between the pixels' centres follow from their slopes.
    grid = np.zeros((*area.shape, 2))
    grid[area] = lens.rays(np.column_stack([columns, rows]).astype(np.float64))[:, :2]
    fx, fy = lens.values[:2]
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    samples = []
    for du in steps:
        for dv in steps:
            xy = grid[area] + [du / fx, dv / fy]
            rays = np.column_stack([xy, np.ones(len(xy))])
            points = points_on_board(T_camera_board, rays)
            samples.append(_print_chessboard(board, (points - t) @ R[:, :2], is_legacy))
    shading[area] = np.mean(samples, axis=0)
    return _blur(shading, area, blur_px)


def _print_chessboard(board: Board, places_mm: Float64, is_legacy: bool) -> Float64:
    """Return a board's reflectance (n,) at places (n, 2), mm, from its first inner corner."""
    cell = places_mm / board.square_mm
    if board.kind is BoardKind.CHESSBOARD:
        return np.asarray(np.floor(cell).sum(axis=1) % 2.0)
    drawn = _print_charuco(board, is_legacy)
    index = np.floor((cell + 1.0) * CELL_PX).astype(np.int64)
    column, row = (index[:, n].clip(0, drawn.shape[1 - n] - 1) for n in (0, 1))
    return np.asarray(drawn[row, column] / 255.0)


def _print_charuco(board: Board, is_legacy: bool) -> Integers:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    size = board.columns + 1, board.rows + 1
    pattern = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary)
    pattern.setLegacyPattern(is_legacy)
    return np.asarray(pattern.generateImage((size[0] * CELL_PX, size[1] * CELL_PX)))


def _blur(image: Float64, area: Bool, blur_px: float) -> Float64:
    if not blur_px > 0.0:
        return image
    filled = cv2.GaussianBlur(np.where(area, image, 0.0), (0, 0), blur_px)
    weight = cv2.GaussianBlur(area.astype(np.float64), (0, 0), blur_px)
    return np.where(area, filled / np.maximum(weight, 1e-6), np.nan)


@dataclass(frozen=True)
class LitBoard:
    """The stripe's light on a lit board.

    `light` is the image less `board_dn` (H, W), the rendered board, 0 outside of it. `contrast_dn` is the
    light squares' level over the dark ones', `rest_dn` 1 sigma of the residual over the board without the
    stripe.
    """

    light: LaserLight
    board_dn: Float64
    contrast_dn: float
    rest_dn: float


def lit_board(
    image_dn: Integers, board: Board, lens: Lens, T_camera_board: Float64, blur_px: float
) -> LitBoard:
    """Subtract the rendered board from an image (H, W) of board and stripe.

    `T_camera_board` (4, 4) is mm, `blur_px` the point-spread function's sigma. The noise of the residual is
    larger along the squares' edges.
    """
    # Boards of an even number of rows begin with another colour since OpenCV 4.6.
    ways = (False, True) if board.kind is BoardKind.CHARUCO else (False,)
    drawings = (
        board_shading(board, lens, T_camera_board, blur_px, is_legacy=is_legacy) for is_legacy in ways
    )
    return min((_without_board(image_dn, drawing) for drawing in drawings), key=lambda lit: lit.rest_dn)


def _without_board(image_dn: Integers, shading: Float64) -> LitBoard:
    area = np.isfinite(shading)
    value, shade = image_dn[area].astype(np.float64), shading[area]
    rows, columns = np.nonzero(area)
    x, y = (2.0 * (each - each.mean()) / max(np.ptp(each), 1) for each in (columns, rows))
    smooth = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    drawn_board = np.where(area, shading, np.nanmean(shading))
    slopes = np.gradient(drawn_board)
    by_blur = sum(np.gradient(slope, axis=n) for n, slope in enumerate(slopes))
    # A board that is a little off its pose, or blurred otherwise, differs along its squares' edges.
    edges = np.column_stack([slope[area] for slope in (*slopes, by_blur)])
    A = np.column_stack([smooth, smooth * shade[:, np.newaxis], edges])
    at_edge = np.hypot(edges[:, 0], edges[:, 1]) > EDGE_SHARE
    rest = value - A @ _fit(A, value, at_edge)
    light, noise = np.zeros(image_dn.shape, np.float32), np.ones(image_dn.shape, np.float32)
    drawn = np.zeros(image_dn.shape)
    light[area], drawn[area] = rest, value - rest
    noise[area] = np.where(
        at_edge, *(max(spread(rest[part]), NOISE_FLOOR_DN) for part in (at_edge, ~at_edge))
    )
    low, high = np.quantile(drawn[area], [0.1, 0.9])
    return LitBoard(LaserLight(light, noise, area), drawn, float(high - low), spread(rest))


def _fit(A: Float64, value: Float64, at_edge: Bool) -> Float64:
    """Return the coefficients (m,) of A (n, m) that leave least of most values (n,)."""
    step = max(1, len(value) // MAX_PIXELS)
    A, value, at_edge = A[::step], value[::step], at_edge[::step]
    kept = np.ones(len(value), dtype=bool)
    coefficients = np.zeros(A.shape[1])
    for _ in range(ROUNDS):
        H = A[kept].T @ A[kept]
        # The ridge serves a board of one shade.
        coefficients = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(len(H)), A[kept].T @ value[kept])
        rest = value - A @ coefficients
        sigma = np.where(at_edge, spread(rest[at_edge]), spread(rest[~at_edge]))
        kept = np.abs(rest) <= TRIM_SIGMAS * np.maximum(sigma, 1.0)
    return coefficients

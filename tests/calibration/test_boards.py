from collections.abc import Callable

import cv2
import numpy as np
import pytest
from camera_scenes import BOARD, picture

from calibration.boards.board import Board
from calibration.boards.detect import Corners, find_corners
from noise_model.compiled.arrays import Float64, UInt8

pytestmark = pytest.mark.slow

CHARUCO = Board.parse("charuco:8x6:10mm:7mm:5X5_100")
SIZE = (480, 360)
CHESS = BOARD
H = np.array([[4.2, 0.5, 60.0], [-0.35, 4.0, 75.0], [0.0006, -0.0009, 1.0]])
"""Board in mm to image in px, a board that leans."""


def seen_at(board: Board, homography: Float64 = H) -> Float64:
    """Return where a board's corners are in the image (n, 2), px."""
    points = np.column_stack([board.points_mm[:, :2], np.ones(len(board.points_mm))]) @ homography.T
    return points[:, :2] / points[:, 2:]


def chessboard(homography: Float64 = H) -> UInt8:
    """Return a picture of the chessboard."""
    return picture(homography, SIZE)


def charuco() -> UInt8:
    """Return a picture of the ChArUco board, warped by OpenCV from its own drawing of it."""
    squares = CHARUCO.columns + 1, CHARUCO.rows + 1
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    drawn = cv2.aruco.CharucoBoard(squares, 10.0, 7.0, dictionary).generateImage((1600, 1200), marginSize=0)
    # The drawing's first inner corner lies 10 mm in from its edge.
    to_drawing = np.array([[20.0, 0.0, 199.5], [0.0, 20.0, 199.5], [0.0, 0.0, 1.0]])
    warped = cv2.warpPerspective(
        cv2.GaussianBlur(drawn, (0, 0), 2.0),
        H @ np.linalg.inv(to_drawing),
        SIZE,
        flags=cv2.INTER_AREA,
        borderValue=255,
    )
    return cv2.GaussianBlur(warped, (0, 0), 0.7)


def found(image: np.ndarray, board: Board) -> Corners:
    corners = find_corners(image, board)
    assert corners is not None
    return corners


@pytest.mark.parametrize(
    "change",
    [
        lambda image: image,
        lambda image: 255 - image,
        lambda image: (20 + image // 12).astype(np.uint8),
        lambda image: image.astype(np.uint16) * 257,
        lambda image: (image * np.linspace(0.15, 1.0, SIZE[0])).astype(np.uint8),
    ],
    ids=["plain", "inverted", "dim", "16 bits", "uneven light"],
)
def test_a_chessboards_corners_are_where_they_are(change: Callable[[UInt8], np.ndarray]) -> None:
    corners = found(change(chessboard()), CHESS)
    assert corners.corners.tolist() == list(range(42))
    off = np.linalg.norm(corners.points_px - seen_at(CHESS), axis=1)
    turned = np.linalg.norm(corners.points_px[::-1] - seen_at(CHESS), axis=1)
    assert min(off.max(), turned.max()) < 0.3


def test_a_boards_end_is_told_by_its_colours() -> None:
    """A board of an odd and an even side is counted from the same corner however it is turned."""
    turned = H @ np.array([[-1.0, 0.0, 60.0], [0.0, -1.0, 50.0], [0.0, 0.0, 1.0]])
    first, second = found(chessboard(), CHESS), found(chessboard(turned), CHESS)
    assert first.points_px == pytest.approx(second.points_px[::-1], abs=0.3)


def test_a_board_that_is_cut_off_is_none_but_markers_tell_a_part() -> None:
    cut = chessboard()
    cut[:, :120] = 200
    assert find_corners(cut, CHESS) is None
    part = charuco()
    part[:, :160] = 255
    corners = found(part, CHARUCO)
    assert 10 < len(corners.corners) < 35
    assert np.linalg.norm(corners.points_px - seen_at(CHARUCO)[corners.corners], axis=1).max() < 0.4


def test_markers_tell_all_corners_apart_also_inverted() -> None:
    for image in (charuco(), 255 - charuco()):
        corners = found(image, CHARUCO)
        assert corners.corners.tolist() == list(range(35))
        assert np.linalg.norm(corners.points_px - seen_at(CHARUCO), axis=1).max() < 0.4


@pytest.mark.slow
def test_no_board_is_found_where_there_is_none() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8)
    assert find_corners(noise, CHESS) is None
    assert find_corners(np.full((40, 50), 7, dtype=np.uint8), CHARUCO) is None

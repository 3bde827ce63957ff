"""Boards that Mitsuba renders show corners and stripes where closed forms have them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board
from calibration.boards.detect import find_corners
from noise_model.compiled.arrays import Float64

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from camera_worlds import World, project
from mitsuba_boards import Lamp, Paper, Sensor, Sheet, Studio, undistorted

SIZE, DISTANCE_MM = (400, 300), 160.0
LENS = {"fx": 1000.0, "fy": 1002.0, "cx": 203.0, "cy": 147.0, "k1": -0.2, "k2": 0.1}
WARP_MM = np.array([0.2, -0.15])
TURN = Rotation.from_euler("XYZ", [10.0, -12.0, 8.0], degrees=True)


def studio(strata: int) -> Studio:
    """Return a lit room with a camera whose noise is small."""
    aim = np.array([0.0, 0.0, DISTANCE_MM])
    lamp = Lamp(np.array([120.0, -90.0, 10.0]), 12.0, aim, 0.6)
    sensor = Sensor(SIZE, LENS, 0.4, DISTANCE_MM, full_well_e=1e6, read_noise_e=10.0, bits=12, strata=strata)
    return Studio(sensor, lamp, np.random.default_rng(4))


def held(board: Board) -> Float64:
    """Return the translation, mm, that puts a board's middle before the camera."""
    span = np.array([board.columns - 1, board.rows - 1, 0]) * board.square_mm
    return np.array([0.0, 0.0, DISTANCE_MM]) - TURN.apply(0.5 * span)


def test_the_lens_inverse_is_undone_by_the_lens() -> None:
    image = np.random.default_rng(1).uniform(0.0, SIZE, (500, 2))
    lens = {**LENS, "p1": 1e-3, "p2": -2e-3}
    back = project(lens, np.column_stack([undistorted(lens, image), np.ones(500)]))
    np.testing.assert_allclose(back, image, rtol=0.0, atol=1e-4)


def test_a_lens_that_folds_is_refused() -> None:
    with pytest.raises(ValueError, match="folds"):
        undistorted({**LENS, "k1": -3.0}, np.array([[-500.0, -500.0]]))


@pytest.mark.slow
@pytest.mark.parametrize("stated", ["chessboard:6x5:5mm", "charuco:7x6:5mm:3.8mm:4X4_50"])
def test_corners_are_where_the_closed_form_has_them(mitsuba: object, stated: str) -> None:
    board, room = Board.parse(stated), studio(strata=7)
    picture = room.picture(room.light_e(Paper(board, WARP_MM, 0.25), TURN.as_matrix(), held(board)))
    corners = find_corners(picture, board)
    assert corners is not None
    assert len(corners.corners) == board.columns * board.rows
    pose = (TURN, held(board))
    world = World(SIZE, "", LENS, (board.columns, board.rows), 5.0, WARP_MM, [pose], np.ones(1))
    truth = project(LENS, world.corners_camera(0))[corners.corners]
    # A chessboard may be counted from its other end; markers tell the ends.
    ends = [corners.points_px] if board.dictionary else [corners.points_px, corners.points_px[::-1]]
    off = min((points - truth for points in ends), key=lambda each: float(np.abs(each).sum()))
    assert np.sqrt(np.mean(off**2)) < 0.05
    assert np.abs(off.mean(axis=0)).max() < 0.02


@pytest.mark.slow
def test_the_stripe_lies_in_the_sheet(mitsuba: object) -> None:
    board, room = Board.parse("chessboard:6x5:5mm"), studio(strata=4)
    aim = np.array([0.0, 0.0, DISTANCE_MM])
    origin = np.array([0.0, 90.0, 30.0])
    middle = (aim - origin) / np.linalg.norm(aim - origin)
    sheet = Sheet(origin, middle, np.array([1.0, 0.0, 0.0]), 2e-3, 0.2, aim, 2.0)
    np.testing.assert_allclose(sheet.plane[:3] @ aim + sheet.plane[3], 0.0, atol=1e-9)
    paper, R, t = Paper(board, np.zeros(2), 0.4), TURN.as_matrix(), held(board)
    light, unlit = room.light_e(paper, R, t, sheet), room.light_e(paper, R, t)
    u = np.arange(150, 250)
    v = np.arange(SIZE[1]) @ light[:, u] / light[:, u].sum(axis=0)
    rays = np.column_stack([undistorted(LENS, np.column_stack([u, v])), np.ones(len(u))])
    normal = TURN.apply([0.0, 0.0, 1.0])
    points = rays * (normal @ held(board) / (rays @ normal))[:, np.newaxis]
    off_mm = points @ sheet.plane[:3] + sheet.plane[3]
    # Where an edge of squares is near, it draws the centroid to the light side.
    near = unlit[np.rint(v).astype(int) + np.arange(-8, 9)[:, np.newaxis], u]
    is_even = np.ptp(near, axis=0) < 0.5 * near.mean(axis=0)
    assert is_even.sum() > 10
    assert np.abs(off_mm[is_even]).max() < 0.01
    assert np.abs(off_mm[is_even].mean()) < 0.003

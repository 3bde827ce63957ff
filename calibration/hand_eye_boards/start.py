"""Start of the refinement: camera and board from a few poses each, chosen by how many others they explain.

OpenCV's five methods use all poses, and Park's many triples of them. Taken is the result that brings the
median board nearest to where it is seen. A wrong pair of image and pose spoils only some of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import cv2
import numpy as np

from calibration.boards.board import Board
from calibration.camera.lens import Lens
from calibration.camera.printed import has_distinct_ends
from calibration.camera.sightings import Sightings
from calibration.hand_eye_boards.chain import Chain
from calibration.rigid import inverse, mean_pose
from noise_model.compiled.arrays import Float64
from noise_model.transforms import transform

METHODS = (
    cv2.CALIB_HAND_EYE_TSAI,
    cv2.CALIB_HAND_EYE_PARK,
    cv2.CALIB_HAND_EYE_HORAUD,
    cv2.CALIB_HAND_EYE_ANDREFF,
    cv2.CALIB_HAND_EYE_DANIILIDIS,
)

TRIPLES = 60
"""Triples of poses: with two wrong pairs in five, none of 60 triples is right once in a million times."""

SEED = 1


def first_chain(
    T_base_tool: Float64, T_camera_board: Float64, board: Board, lens: Lens, *, is_eye_to_hand: bool
) -> tuple[Chain, Float64, Float64]:
    """Return the chain that explains the median board best, the boards' poses, and the errors of their ends.

    `T_base_tool` and `T_camera_board` (V, 4, 4) are mm. The ends of some boards cannot be told apart: the
    returned poses (V, 4, 4) are turned to the end that fits. The errors (V,) are px, RMS.
    """
    turns = symmetries(board)
    turned = T_camera_board[:, np.newaxis] @ turns
    ends = np.array(
        [[x, y, 0.0, 1.0] for x, y in product(*((0.0, side) for side in board.points_mm.max(axis=0)[:2]))]
    )
    shown = _seen(lens, turned, ends)
    best: tuple[float, Chain, Float64] | None = None
    empty = Chain(T_base_tool, np.eye(4), np.eye(4), is_eye_to_hand)
    for chain in _candidates(empty, turned):
        off = _off_px(lens, chain, ends, shown)
        score = float(np.median(off.min(axis=1)))
        if best is None or score < best[0]:
            best = score, chain, off
    if best is None:
        raise np.linalg.LinAlgError("no method finds a camera")
    _, chain, off = best
    rows = np.arange(len(off))
    chosen = off.argmin(axis=1)
    return chain, turned[rows, chosen], off[rows, chosen]


def symmetries(board: Board) -> Float64:
    """Return the turns (n, 4, 4) of a board that bring its corners onto each other, the identity first."""
    if has_distinct_ends(board):
        return np.eye(4)[np.newaxis]
    middle = 0.5 * board.points_mm.max(axis=0)
    quarters = (0, 1, 2, 3) if board.columns == board.rows else (0, 2)
    turns = np.tile(np.eye(4), (len(quarters), 1, 1))
    for T, quarter in zip(turns, quarters, strict=True):
        T[:3, :3] = np.round(cv2.Rodrigues(np.array([0.0, 0.0, 0.5 * np.pi * quarter]))[0])
        T[:3, 3] = middle - T[:3, :3] @ middle
    return turns


def renumber(seen: Sightings, T_camera_board: Float64, T_camera_turned: Float64) -> Sightings:
    """Return corners with the numbers that they have after each board (V, 4, 4) is turned to another end."""
    corner = seen.corner.copy()
    points = seen.board.points_mm
    for part, T_turned_board in zip(seen.slices, inverse(T_camera_turned) @ T_camera_board, strict=True):
        places = transform(T_turned_board, points[seen.corner[part]])
        column, row, _ = np.rint(places / seen.board.square_mm).astype(np.int64).T
        corner[part] = row * seen.board.columns + column
    return replace(seen, corner=corner)


def opencv_chain(empty: Chain, T_camera_board: Float64, method: int) -> Chain | None:
    """Return the chain of one of OpenCV's methods, None where it finds none.

    OpenCV calls the camera's pose in the tool cam2gripper. Eye to hand is the same with the robot's poses
    inverted.
    """
    T_mount_holder = inverse(empty.T_holder_mount)
    try:
        R, t = cv2.calibrateHandEye(
            list(T_mount_holder[:, :3, :3]),
            list(T_mount_holder[:, :3, 3]),
            list(T_camera_board[:, :3, :3]),
            list(T_camera_board[:, :3, 3]),
            method=method,
        )
    except cv2.error:
        return None
    # Of poses that contradict each other some methods make no rotation.
    if not (np.isfinite(t).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0):
        return None
    T_holder_camera = np.eye(4)
    T_holder_camera[:3, :3], T_holder_camera[:3, 3] = R, t.ravel()
    T_mount_board = mean_pose(T_mount_holder @ T_holder_camera @ T_camera_board)
    return replace(empty, T_holder_camera=T_holder_camera, T_mount_board=T_mount_board)


def _candidates(empty: Chain, turned: Float64) -> Iterator[Chain]:
    count, ways = turned.shape[:2]
    if ways == 1:
        for method in METHODS:
            yield from _some(opencv_chain(empty, turned[:, 0], method))
    rng = np.random.default_rng(SEED)
    for _ in range(TRIPLES):
        triple = rng.choice(count, 3, replace=False).tolist()
        part = empty.select_views(triple)
        # The first board's end is free: the board's own frame turns with it.
        for other in product((0,), range(ways), range(ways)):
            chain = opencv_chain(part, turned[triple, other], cv2.CALIB_HAND_EYE_PARK)
            yield from (replace(each, T_base_tool=empty.T_base_tool) for each in _some(chain))


def _some(chain: Chain | None) -> Sequence[Chain]:
    return () if chain is None else (chain,)


def _seen(lens: Lens, T: Float64, ends: Float64) -> Float64:
    """Return the image points (..., 4, 2), px, of the ends of boards at poses (..., 4, 4), undistorted."""
    points = np.einsum("...ij,nj->...ni", T[..., :3, :], ends)
    return np.asarray(lens.values[:2] * points[..., :2] / points[..., 2:].clip(1e-6))


def _off_px(lens: Lens, chain: Chain, ends: Float64, shown: Float64) -> Float64:
    off = shown - _seen(lens, chain.T_camera_board, ends)[:, np.newaxis]
    return np.asarray(np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=-1)))

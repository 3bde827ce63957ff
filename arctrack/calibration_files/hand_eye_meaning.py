"""What the robot's poses may mean where they contradict the boards: another convention, unit, or place."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations

import numpy as np

from arctrack.calibration_files.hand_eye_poses import PosedBoards
from arctrack.importing.rotations import CONVENTIONS, NoRotationError, convention
from arctrack.importing.units import ANGLE, LENGTH, UNITS, factor
from calibration.camera.enough import UndeterminedError
from calibration.hand_eye_boards.angles import angle_mismatch_deg
from calibration.hand_eye_boards.calibrate import calibrate_hand_eye
from noise_model.arrays import Float64

FITS_DEG = 1.5
"""Robot and board turn by the same angles where these differ by less, the median of all pairs of images."""

SEQUENCES = tuple("".join(axes) for letters in ("ZYX", "xyz") for axes in permutations(letters)) + tuple(
    f"{first}{second}{first}" for letters in ("ZYX", "xyz") for first, second in permutations(letters, 2)
)
"""All sequences of three axes, those that turn along first."""


def other_meaning(posed: PosedBoards, rotation: str | None, *, is_eye_to_hand: bool) -> str | None:
    """Return what makes poses fit that contradict the boards as they were stated, None if nothing does.

    The first of these counts that the calibration takes: the camera is carried or stands still, controllers'
    conventions, sequences of axes, positions in another unit.

    Parameters
    ----------
    posed : PosedBoards
        Boards and poses.
    rotation : str or None
        How rotations were said to be written.
    is_eye_to_hand : bool
        Whether the camera was said to stand still.
    """
    board = posed.scene.T_camera_board
    for words, T_base_tool in _meanings(posed, rotation):
        # This angle has no axes: it is the same in base and tool, and asks no fit.
        if angle_mismatch_deg(T_base_tool, board) > FITS_DEG:
            continue
        for is_flipped in (True, False) if not words else (False, True):
            if not words and not is_flipped:
                continue
            try:
                calibrate_hand_eye(
                    posed.scene, posed.seen, T_base_tool, is_eye_to_hand=is_eye_to_hand != is_flipped
                )
            except UndeterminedError:
                continue
            switch = "no --eye-to-hand" if is_eye_to_hand else "--eye-to-hand"
            return " with ".join(filter(None, (words, switch if is_flipped else "")))
    return None


def _meanings(posed: PosedBoards, rotation: str | None) -> Iterator[tuple[str, Float64]]:
    """Yield words that state another meaning of the poses, and the poses (V, 4, 4); the stated one first."""
    yield "", posed.T_base_tool
    if posed.poses.rotation is not None:
        yield from _rotations(posed, posed.poses.rotation[posed.rows], rotation)
    for unit, mm in UNITS[LENGTH].items():
        stated = next(mm for name, mm in UNITS[LENGTH].items() if name in posed.poses.units.split(", "))
        if mm != stated:
            T_base_tool = posed.poses.T_base_tool[posed.rows]
            T_base_tool[:, :3, 3] *= mm / stated
            yield f"positions in {unit}", T_base_tool @ posed.T_controllertool_tool


def _rotations(posed: PosedBoards, numbers: Float64, stated: str | None) -> Iterator[tuple[str, Float64]]:
    for name in (*CONVENTIONS, *SEQUENCES):
        written = convention(name)
        if len(written.columns[0]) != numbers.shape[1]:
            continue
        for unit in UNITS[ANGLE] if written.are_angles else [""]:
            try:
                R = written.matrices(numbers * (factor(ANGLE, unit) if unit else 1.0))
            except NoRotationError:
                continue
            T_base_tool = posed.poses.T_base_tool[posed.rows]
            if np.allclose(T_base_tool[:, :3, :3], R):
                continue  # The same by another name.
            T_base_tool[:, :3, :3] = R
            words = f"--rotation {name}" if name != stated else ""
            if unit not in ("", "deg" if written.units.angle is None else written.units.angle):
                words = " and ".join(filter(None, (words, f"angles in {unit}")))
            if words:
                yield words, T_base_tool @ posed.T_controllertool_tool

"""Calibration of the laser sheet from board images without and with the laser."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from arctrack.calibrate.laser.laser_pairs import read_pairs
from arctrack.calibrate.laser.page import laser_page
from arctrack.calibrate.laser.record import laser_record
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import SetupFile
from calibration.boards.board import Board
from calibration.camera.enough import UndeterminedError
from calibration.laser.beam import fit_beam
from calibration.laser.calibrate import LaserCalibration, calibrate_laser


def laser_stage(
    sources: Sequence[Path],
    board: Board,
    stated: SetupFile,
    steps: Steps,
    warn: Warn,
) -> CalibrationStage[LaserCalibration]:
    """Find the laser sheet in images of a board; ArctrackError says which images it still needs."""
    pairs = read_pairs(sources, board, stated, steps("looking for board and stripe", "images"))
    warn(left_out(pairs.left_out))
    try:
        result = calibrate_laser(pairs.scene, pairs.seen, pairs.stripes, pairs.lens_covariance)
    except UndeterminedError as error:
        raise in_file(sources[0], str(error)) from None
    warn(left_out(result.left_out))
    beam = fit_beam(result, pairs.sections, pairs.scene.lens, stated.setup.camera, stated.setup.laser)
    page = laser_page(result, pairs, beam, stated.setup)
    return CalibrationStage(result, page, (laser_record(result, beam, stated.setup),))

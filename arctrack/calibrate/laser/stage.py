"""Calibration of the laser sheet from board images without and with the laser."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from arctrack.calibrate.laser.laser_pairs import LaserPairs, read_pairs
from arctrack.calibrate.laser.page import laser_page
from arctrack.calibrate.laser.record import laser_record
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import SetupFile
from calibration.boards.board import Board
from calibration.camera.enough import UndeterminedError
from calibration.laser.beam import Beam, fit_beam
from calibration.laser.calibrate import LaserCalibration, calibrate_laser
from calibration.laser.plane import LaserStand
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser


def laser_stage(
    sources: Sequence[Path], board: Board, stated: SetupFile, steps: Steps, warn: Warn
) -> CalibrationStage[LaserCalibration]:
    """Find the laser sheet in images of a board; ArctrackError says which images it still needs."""
    pairs = read_pairs(sources, board, stated, steps("looking for board and stripe", "images"))
    warn(left_out(pairs.left_out))
    try:
        result, beam = _fit(pairs, stated.setup.camera, stated.setup.laser)
        if result.fit.bow and not isinstance(beam.fan, str):
            # The bow counts from the origin, which is known only now.
            x, y, z = beam.origin_mm.tolist()
            laser = replace(stated.setup.laser, origin_in_tool_mm=(x, y, z))
            result, beam = _fit(pairs, stated.setup.camera, laser)
    except UndeterminedError as error:
        raise in_file(sources[0], str(error)) from None
    warn(left_out(result.left_out))
    page = laser_page(result, pairs, beam, stated.setup)
    return CalibrationStage(result, page, (laser_record(result, beam, stated.setup),))


def _fit(pairs: LaserPairs, camera: Camera, laser: Laser) -> tuple[LaserCalibration, Beam]:
    stand = LaserStand.of(laser, camera.T_tool_camera)
    result = calibrate_laser(pairs.scene, pairs.seen, pairs.stripes, stand, pairs.lens_covariance)
    return result, fit_beam(result, pairs.sections, pairs.scene.lens, camera, laser)

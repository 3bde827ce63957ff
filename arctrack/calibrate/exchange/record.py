"""An imported lens as recording.toml holds it."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from arctrack.calibrate.exchange.lens_file import LensFile
from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, SetupFile
from arctrack.recording.key_errors import wrong_keys
from arctrack.recording.sensor_tables import CameraTable
from arctrack.recording.setup_file import setup_text, stated_keys
from arctrack.recording.toml_text import rounded

RESTS_ON_THE_LENS = ("hand_eye", "laser")
"""Calibrations whose values hold for the lens that they were found with."""


def imported_camera(read: LensFile, path: Path, stated: SetupFile) -> CalibrationValues:
    """Return an imported lens as values of `[camera]`; ArctrackError where they are none for a setup.

    The file says nothing of their covariance: the record has none.
    """
    camera = stated.setup.camera
    if read.size is not None and read.size != (camera.width, camera.height):
        raise in_file(
            path,
            f"is of images of {read.size[0]} x {read.size[1]} px, but [camera] width, height of "
            f"{stated.path} are {camera.width} x {camera.height}: a lens belongs to one image size; import "
            "the lens of the frames, or state their size",
        )
    table = stated_keys(setup_text(stated.path), stated.path).camera
    try:
        CameraTable.model_validate(table.model_dump() | read.values)
    except ValueError as error:
        raise wrong_keys(path, error, CameraTable) from None
    about: dict[str, str | float] = {"source": path.name, "program": read.program}
    if read.error_px:
        about["conversion_error_px"] = rounded(read.error_px, 2)
    return CalibrationValues("camera", read.values, (), np.zeros((0, 0)), "arctrack calibrate import", about)


def import_notes(read: LensFile, path: Path, stated: SetupFile) -> Iterator[str]:
    """Yield warnings on an imported lens: what it lacks, and what rests on the lens before."""
    camera = stated.setup.camera
    if read.not_taken:
        yield f"{path}: {', '.join(read.not_taken)}: no pose of the camera on the robot, not taken"
    if read.size is None:
        yield f"{path}: has no image size: it is taken for that of {camera.width} x {camera.height} px"
    elif not read.lens.is_invertible:
        yield f"{path}: the distortion folds the image before its corners: the lens is not usable there"
    before = (camera.fx, camera.fy, camera.cx, camera.cy)
    resting = [f"[calibration.{name}]" for name in RESTS_ON_THE_LENS if name in stated.calibrations]
    if resting and before != read.pinhole:
        yield f"{stated.path}: {', '.join(resting)}: found with the lens before; calibrate anew"

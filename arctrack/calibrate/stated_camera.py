"""The camera that a setup states, for boards seen before it: its lens, and how well that is known."""

from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.recording import SetupFile
from arctrack.recording.setup_model import CalibrationTable
from calibration.camera.known_lens import lens_from_camera
from calibration.camera.lens import Lens
from noise_model.calibration_errors import PINHOLE
from noise_model.compiled.arrays import Float64


def check_size(size: tuple[int, int], stated: SetupFile) -> None:
    """Raise ArctrackError for images whose width and height, px, are not the camera's."""
    camera = stated.setup.camera
    if size != (camera.width, camera.height):
        raise ArctrackError(
            f"{stated.path}: [camera] width, height: {camera.width} x {camera.height}, but the images are "
            f"{size[0]} x {size[1]} px: `arctrack calibrate camera` comes first"
        )


def stated_lens(stated: SetupFile) -> tuple[Lens, Float64 | None]:
    """Return the lens that a setup states, with all parameters of its calibration, and their covariance.

    The covariance (n, n) is None where the setup keeps none; ArctrackError where what it keeps is none.
    """
    record = stated.calibrations.get("camera")
    lens = lens_from_camera(stated.setup.camera, [] if record is None else record.parameters)
    return lens, None if record is None else _covariance(record, lens, stated.path)


def _covariance(record: CalibrationTable, lens: Lens, path: Path) -> Float64 | None:
    """Return the covariance (n, n) of a lens' parameters that a calibration has; None if it lacks some."""
    rows = {name: row for row, name in enumerate(record.parameters)}
    try:
        whole = record.matrix("calibration.camera")
    except ValueError as error:
        raise in_file(path, str(error)) from None
    if not set(PINHOLE) <= set(rows):
        return None
    covariance = np.zeros((len(lens.names), len(lens.names)))
    known = [n for n, name in enumerate(lens.names) if name in rows]
    picked = [rows[lens.names[n]] for n in known]
    covariance[np.ix_(known, known)] = whole[np.ix_(picked, picked)]
    return covariance

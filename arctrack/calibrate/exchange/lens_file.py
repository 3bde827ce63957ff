"""A lens of another program's file, in OpenCV's terms, and as recording.toml holds it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, SetupFile
from arctrack.recording.files import UnfitFileError
from arctrack.recording.key_errors import wrong_keys
from arctrack.recording.sensor_tables import CameraTable
from arctrack.recording.setup_file import setup_text, stated_keys
from arctrack.recording.toml_text import rounded
from calibration.camera.known_lens import fit_distortion
from calibration.camera.lens import Lens
from noise_model.calibration_errors import OPENCV, PINHOLE
from noise_model.compiled.arrays import Float64
from noise_model.setup_keys import COEFFICIENTS

MAX_ERROR_PX = 0.5
"""Largest error of a fitted distortion, px: boards' corners fit a usable calibration better than that."""

MAX_ASPECT = 2.0
"""Largest ratio of fx and fy: binning along one side doubles it, and no pixels are longer."""


@dataclass(frozen=True)
class LensFile:
    """A lens as another program's file states it.

    `size` is (width, height), px, None where the file has none; `distortion` are OpenCV's first
    coefficients. `error_px` is the largest error of a distortion that was fitted, 0 of one that OpenCV has.
    `not_taken` names content that a setup has no place for.
    """

    program: str
    size: tuple[int, int] | None
    pinhole: tuple[float, float, float, float]
    distortion: tuple[float, ...] = ()
    error_px: float = 0.0
    not_taken: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        fx, fy, cx, cy = self.pinhole
        if not (fx > 0.0 and fy > 0.0):
            raise UnfitFileError(
                f"fx = {fx:g}, fy = {fy:g}: must be above 0; a camera without calibration has 0"
            )
        if not 1.0 / MAX_ASPECT <= fx / fy <= MAX_ASPECT:
            raise UnfitFileError(
                f"fx = {fx:g}, fy = {fy:g}, cx = {cx:g}, cy = {cy:g}: fx and fy differ more than twofold; "
                "is this their order?"
            )

    @property
    def lens(self) -> Lens:
        """The lens, of 1 x 1 px where the file has no size."""
        width, height = self.size or (1, 1)
        values = np.array([*self.pinhole, *self.distortion])
        return Lens(width, height, (*PINHOLE, *OPENCV[: len(self.distortion)]), values)

    @property
    def values(self) -> dict[str, float | list[float]]:
        """The keys of `[camera]` with their values."""
        count = next(count for count in COEFFICIENTS if count >= len(self.distortion))
        padded = [*self.distortion, *[0.0] * (count - len(self.distortion))]
        return {**dict(zip(PINHOLE, self.pinhole, strict=True)), "distortion": padded}


def fitted_lens(
    program: str,
    size: tuple[int, int] | None,
    pinhole: tuple[float, float, float, float],
    undistorted: Callable[[Float64], Float64],
    model: str,
    not_taken: Sequence[str] = (),
) -> LensFile:
    """Return a lens whose distortion OpenCV's was fitted to; UnfitFileError where none comes near.

    `undistorted` is that of `calibration.camera.known_lens`, `model` names it.
    """
    if size is None:
        raise UnfitFileError(f"has no image size, which the conversion of a {model} distortion needs")
    plain = LensFile(program, size, pinhole, (), 0.0, tuple(not_taken))
    try:
        lens, error_px = fit_distortion(plain.lens, undistorted)
    except ValueError as error:
        raise UnfitFileError(f"the {model} distortion {error}") from None
    if error_px > MAX_ERROR_PX:
        raise UnfitFileError(
            f"the {model} distortion has no counterpart of OpenCV's: the nearest is {error_px:.2g} px off, "
            f"{MAX_ERROR_PX:g} px at most; `arctrack calibrate camera` finds one of OpenCV's"
        )
    used = max((OPENCV.index(name) + 1 for name in lens.names[4:]), default=0)
    distortion = tuple(float(value) for value in lens.distortion[:used])
    return LensFile(program, size, pinhole, distortion, error_px, tuple(not_taken))


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

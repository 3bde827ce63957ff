"""A lens read from a file of mrcal, Kalibr, ROS, OpenCV or HALCON, told by its content."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arctrack.calibrate.exchange.halcon import halcon_lens
from arctrack.calibrate.exchange.lens_file import LensFile, fitted_lens
from arctrack.calibrate.exchange.stated_keys import StatedKeys
from arctrack.calibrate.exchange.tables import tables_of
from arctrack.limits import LIMITS
from arctrack.recording.files import UnfitFileError, blamed_on, read_text
from noise_model.compiled.arrays import Float64

MRCAL = {"PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}
"""mrcal's models that are OpenCV's, with the number of their coefficients."""

MATRIX = re.compile(r"(?:camera_?matrix|intrinsic_?matrix|mtx|k|m)_?(\d?)", re.IGNORECASE)
"""Key of a 3 x 3 matrix in files of ROS and OpenCV; those of a stereo pair end with a number."""

DISTORTION = r"(?:d|dist|dist(?:ortion)?_?coeff(?:icient)?s?)_?"
"""Key of the distortion beside it, ended by the same number."""

FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
OPENCV_COUNTS = (0, 4, 5, 8, 12, 14)


def read_lens(path: Path, camera: str | None) -> LensFile:
    """Read a lens; `camera` is its name in a file of several.

    Raises ArctrackError that names the file and the key which is missing, is no number, or states a lens that
    a setup cannot hold.
    """
    with blamed_on(path):
        root = tables_of(read_text(path, LIMITS.csv_bytes))
        if "lensmodel" in root or "lens_model" in root:
            return _mrcal(StatedKeys(root))
        if "Focus" in root or "Magnification" in root:
            return halcon_lens(StatedKeys(root))
        chain = {name: table for name, table in root.items() if _is_kalibr(table)}
        if chain or _is_kalibr(root):
            name = _chosen(chain, camera) if chain else ""
            return _kalibr(StatedKeys(chain[name] if chain else root, f"{name}: " if name else ""))
        matrices = {match[1]: key for key in root if (match := MATRIX.fullmatch(key)) and _is_list(root[key])}
        if not matrices:
            raise UnfitFileError(
                "holds no camera that arctrack knows: mrcal's cameramodel, Kalibr's camchain, ROS' "
                "camera_info, OpenCV's camera_matrix or HALCON's camera parameters"
            )
        number = _chosen(matrices, camera)
        return _matrix(root, matrices[number], number)


def _is_list(value: object) -> bool:
    return isinstance(value, list | tuple | Mapping)


def _is_kalibr(table: object) -> bool:
    return isinstance(table, Mapping) and "camera_model" in table


def _chosen(cameras: Mapping[str, Any], camera: str | None) -> str:
    """Return the name of the camera that is asked for; UnfitFileError where it must be stated."""
    if camera is None and len(cameras) == 1:
        return next(iter(cameras))
    if camera is not None and camera in cameras:
        return camera
    names = ", ".join(name or "''" for name in cameras)
    problem = (
        f"holds the cameras {names}: give one as --camera" if camera is None else f"has {names}, no {camera}"
    )
    raise UnfitFileError(problem)


def _four(values: tuple[float, ...]) -> tuple[float, float, float, float]:
    fx, fy, cx, cy = values
    return fx, fy, cx, cy


def _mrcal(keys: StatedKeys) -> LensFile:
    name = keys.text("lensmodel", "lens_model")
    count = MRCAL.get(name.removeprefix("LENSMODEL_"))
    if count is None:
        has_cure = name.startswith(("LENSMODEL_SPLINED", "LENSMODEL_CAHVOR"))
        cure = "; mrcal-convert-lensmodel LENSMODEL_OPENCV8 fits one of these" if has_cure else ""
        raise UnfitFileError(
            f"lensmodel = {name}: only PINHOLE, OPENCV4, 5, 8 and 12 are lenses of a setup{cure}"
        )
    values = keys.numbers("intrinsics", counts=(4 + count,))
    return LensFile("mrcal", keys.size("imagersize"), _four(values[:4]), values[4:])


def _kalibr(keys: StatedKeys) -> LensFile:
    model = keys.text("camera_model")
    if model != "pinhole":
        keys.refuse(
            "camera_model", "only pinhole is a lens of a setup; calibrate with --models pinhole-radtan"
        )
    pinhole = _four(keys.numbers("intrinsics", counts=(4,)))
    size = keys.size("resolution")
    not_taken = tuple(name for name in ("T_cam_imu", "T_cn_cnm1", "timeshift_cam_imu") if name in keys)
    distortion = keys.text("distortion_model", default="none")
    if distortion == "none":
        return LensFile("Kalibr", size, pinhole, (), 0.0, not_taken)
    if distortion == "radtan":
        coefficients = keys.numbers("distortion_coeffs", counts=(4,))
        return LensFile("Kalibr", size, pinhole, coefficients, 0.0, not_taken)
    if distortion != "equidistant":
        keys.refuse(
            "distortion_model", "must be radtan, equidistant or none; calibrate with --models pinhole-radtan"
        )
    coefficients = keys.numbers("distortion_coeffs", counts=(4,))
    return fitted_lens("Kalibr", size, pinhole, _without_fisheye(coefficients), distortion, not_taken)


def _matrix(root: Mapping[str, Any], key: str, number: str) -> LensFile:
    """Return the lens of ROS' camera_info or of OpenCV's matrices: its 3 x 3 matrix's key, and its number."""
    keys = StatedKeys(root)
    fx, skew, cx, *rest = keys.numbers(key, counts=(9,))
    if skew != 0.0 or [rest[0], *rest[3:]] != [0.0, 0.0, 0.0, 1.0]:
        keys.refuse(key, "must be fx 0 cx, 0 fy cy, 0 0 1")
    pinhole, size = _as_read_out(keys, (fx, rest[1], cx, rest[2]), _size(keys))
    pattern = DISTORTION + number
    names = [name for name in root if re.fullmatch(pattern, name, re.IGNORECASE)] or [
        "distortion_coefficients"
    ]
    program = "ROS" if "distortion_model" in root else "OpenCV"
    is_fisheye = "fisheye_model" in keys and keys.whole("fisheye_model") != 0
    model = "fisheye" if is_fisheye else keys.text("distortion_model", default="plumb_bob") or "plumb_bob"
    if model in FISHEYE:
        coefficients = keys.numbers(*names, counts=(4,))
        return fitted_lens(program, size, pinhole, _without_fisheye(coefficients), model)
    if model not in ("plumb_bob", "rational_polynomial"):
        keys.refuse(
            "distortion_model",
            "must be plumb_bob, rational_polynomial or equidistant; calibrate anew with one of these",
        )
    counts = OPENCV_COUNTS if program == "OpenCV" or model != "plumb_bob" else (0, 4, 5)
    return LensFile(program, size, pinhole, keys.numbers(*names, counts=counts))


def _size(keys: StatedKeys) -> tuple[int, int] | None:
    for width, height in (
        ("image_width", "image_height"),
        ("width", "height"),
        ("image_Width", "image_Height"),
    ):
        if width in keys or height in keys:
            return keys.whole(width), keys.whole(height)
    return next((keys.size(name) for name in ("image_size", "imageSize", "resolution") if name in keys), None)


def _as_read_out(
    keys: StatedKeys, pinhole: tuple[float, float, float, float], size: tuple[int, int] | None
) -> tuple[tuple[float, float, float, float], tuple[int, int] | None]:
    """Return pinhole and size of the image as read out: the region of interest, its px binned.

    ROS states the matrix of the whole sensor, `roi` in its px, and how many px are combined into one
    (REP 104). Combined px have their centre between those of the first and the last.
    """
    roi = StatedKeys(keys.table("roi"), "roi: ")
    x, y = roi.whole("x_offset", default=0), roi.whole("y_offset", default=0)
    by_x, by_y = (keys.whole(name, default=1) or 1 for name in ("binning_x", "binning_y"))
    fx, fy, cx, cy = pinhole
    if size is not None:
        width, height = roi.whole("width", default=0) or size[0], roi.whole("height", default=0) or size[1]
        if x + width > size[0] or y + height > size[1]:
            keys.refuse("roi", f"reaches beyond the image of {size[0]} x {size[1]} px")
        size = width // by_x, height // by_y
    return (
        fx / by_x,
        fy / by_y,
        (cx - x - 0.5 * (by_x - 1)) / by_x,
        (cy - y - 0.5 * (by_y - 1)) / by_y,
    ), size


def _without_fisheye(coefficients: tuple[float, ...]) -> Callable[[Float64], Float64]:
    """Return what undoes OpenCV's fisheye: slope = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), θ off the axis."""
    D = np.array(coefficients)

    def undistorted(slopes: Float64) -> Float64:
        rays = cv2.fisheye.undistortPoints(slopes[:, None], np.eye(3), D)
        back = cv2.fisheye.distortPoints(rays, np.eye(3), D)
        # OpenCV returns some ray for each point: right is one that comes back.
        is_off = np.abs(back[:, 0] - slopes).max(axis=1, keepdims=True) > 1e-9
        return np.where(is_off, np.nan, rays[:, 0])

    return undistorted

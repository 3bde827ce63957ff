"""A lens read from a file of mrcal, Kalibr, ROS, OpenCV or HALCON, told by its content."""

import ast
import math
import re
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
import yaml

from arctrack.calibrate.exchange.lens_file import LensFile, fitted_lens
from arctrack.limits import LIMITS
from arctrack.recording.files import UnfitFileError, blamed_on, read_text
from arctrack.recording.key_errors import held
from noise_model.compiled.arrays import Float64

MAX_SIDE = 10**6
"""Largest width and height, px, of an image that a file can state."""


class StatedKeys:
    """Keys of a table; `place` stands before a key in messages. A key may go by several names."""

    def __init__(self, table: Mapping[str, Any], place: str = "") -> None:
        self._table = table
        self._place = place

    def __contains__(self, name: str) -> bool:
        return name in self._table

    def refuse(self, name: str, problem: str) -> NoReturn:
        """Raise UnfitFileError with a key, what it holds, and the problem."""
        raise UnfitFileError(f"{held(self._place + name, self._table.get(name, ''))}: {problem}")

    def table(self, name: str) -> Mapping[str, Any]:
        """Return a table, empty if there is none."""
        value = self._table.get(name) or {}
        return value if isinstance(value, Mapping) else self.refuse(name, "must be a table")

    def text(self, *names: str, default: str | None = None) -> str:
        """Return a text, without blanks around it."""
        name, value = self._find(names, default)
        return value.strip() if isinstance(value, str) else self.refuse(name, "must be a text")

    def number(self, *names: str, default: float | None = None) -> float:
        """Return a finite number."""
        name, value = self._find(names, default)
        return _number(self._place + name, value)

    def whole(self, *names: str, default: int | None = None) -> int:
        """Return a whole number of px, 0 or more."""
        name, value = self._find(names, default)
        number = _number(self._place + name, value)
        if not (number.is_integer() and 0 <= number <= MAX_SIDE):
            self.refuse(name, f"must be a whole number, 0 to {MAX_SIDE}")
        return int(number)

    def size(self, *names: str) -> tuple[int, int]:
        """Return width and height, px, of a list of both."""
        width, height = self.numbers(*names, counts=(2,))
        if not all(side.is_integer() and 1 <= side <= MAX_SIDE for side in (width, height)):
            self.refuse(names[0], f"must be whole numbers of px, {MAX_SIDE} at most")
        return int(width), int(height)

    def numbers(self, *names: str, counts: Collection[int]) -> tuple[float, ...]:
        """Return finite numbers of a list, rows, or a matrix with `data`; `counts` are allowed."""
        name, value = self._find(names, None)
        where = self._place + name
        if isinstance(value, Mapping):
            value = value.get("data")
        if not isinstance(value, list | tuple):
            raise UnfitFileError(f"{held(where, value)}: must be a list of numbers")
        flat = [each for row in value for each in (row if isinstance(row, list | tuple) else [row])]
        if len(flat) not in counts:
            wanted = " or ".join(str(count) for count in counts)
            raise UnfitFileError(f"{where}: has {len(flat)} numbers, must have {wanted}")
        return tuple(_number(f"{where}[{n}]", each) for n, each in enumerate(flat))

    def _find(self, names: Collection[str], default: object) -> tuple[str, Any]:
        for name in names:
            if self._table.get(name) is not None:
                return name, self._table[name]
        first = next(iter(names))
        if default is None:
            raise UnfitFileError(f"{self._place}{first}: missing")
        return first, default


def _number(where: str, value: object) -> float:
    # YAML takes 1e-05 for a text.
    number = math.nan
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise UnfitFileError(f"{held(where, value)}: must be a finite number")
    return number


OPENCV_HEADS = ("%YAML", "<?xml", "<opencv_storage")
HALCON_PARAMETER = re.compile(r"^[ \t]*(\w+)[ \t]*:[ \t]*[A-Za-z]\w*[ \t]*:([^;\n]*);", re.MULTILINE)
"""First line of a parameter: name, short name, value. Those of its type and meaning have no short name."""


def tables_of(text: str) -> Mapping[str, Any]:
    """Return the keys of a file's text, with tables as mappings; UnfitFileError for another content."""
    begin = text.lstrip()
    if begin.startswith(OPENCV_HEADS):
        return _opencv(begin)
    if "ParGroup" in text:
        return {name: value.strip().strip('"') for name, value in HALCON_PARAMETER.findall(text)}
    is_dict = re.match(r"(\s*#.*\n|\s*\n)*\s*\{", text) is not None
    content = _python_dict(text) if is_dict else _yaml(text)
    if not isinstance(content, Mapping):
        raise UnfitFileError("holds no keys of a camera")
    return {str(key): value for key, value in content.items()}


def _python_dict(text: str) -> object:
    # ast.literal_eval knows numbers, texts and lists alone, and calls nothing.
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return _yaml(text)


def _yaml(text: str) -> object:
    """Return the first document: a log of a topic has one for each message."""
    try:
        return next(yaml.safe_load_all(text), None)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = None if mark is None else mark.line + 1
        raise UnfitFileError(f"is no YAML: {error.problem or error.context}", line) from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise UnfitFileError("is no YAML") from None


def _opencv(text: str) -> Mapping[str, Any]:
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        content = _content(storage.root())
    except (cv2.error, SystemError):
        raise UnfitFileError("is no valid file of OpenCV's") from None
    return content if isinstance(content, Mapping) else {}


def _content(node: Any) -> object:
    if node.isMap():
        return {name: _content(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_content(node.at(n)) for n in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() or node.isInt() else None


OTHERS = {
    "Magnification": "a telecentric lens is no pinhole",
    "Tilt": "a tilted lens has other parameters in OpenCV",
    "Vx": "a line camera is no area camera",
    "Vy": "a line camera is no area camera",
}
"""Parameters of HALCON's cameras that a setup cannot hold."""


def halcon_lens(keys: StatedKeys) -> LensFile:
    """Return the lens of HALCON's parameters of an area camera, by the division or the polynomial model.

    They are in metres, as `read_cam_par` has them; the models are those of the chapter Calibration of its
    reference manual. Both distortions map the distorted image to the rays: OpenCV's, which go the other way,
    are fitted to them.
    """
    for name, problem in OTHERS.items():
        if name in keys:
            keys.refuse(name, f"{problem}; calibrate it with `arctrack calibrate camera`")
    focus_m, sx_m, sy_m = keys.number("Focus"), keys.number("Sx"), keys.number("Sy")
    for name, value in (("Focus", focus_m), ("Sx", sx_m), ("Sy", sy_m)):
        if value <= 0.0:
            keys.refuse(name, "must be above 0, in m; a telecentric lens, of Focus 0, is no pinhole")
    size = keys.whole("ImageWidth"), keys.whole("ImageHeight")
    pinhole = focus_m / sx_m, focus_m / sy_m, keys.number("Cx"), keys.number("Cy")
    if "Poly1" not in keys:
        kappa = keys.number("Kappa") * focus_m**2
        if kappa == 0.0:
            return LensFile("HALCON", size, pinhole)

        def without_division(slopes: Float64) -> Float64:
            below = 1.0 + kappa * (slopes**2).sum(axis=1, keepdims=True)
            return np.where(below > 0.0, slopes / below, np.nan)

        return fitted_lens("HALCON", size, pinhole, without_division, "division")
    k1, k2, k3, p1, p2 = (keys.number(f"Poly{n}") for n in range(1, 6))

    def without_polynomial(slopes: Float64) -> Float64:
        x, y = focus_m * slopes.T
        r2 = x**2 + y**2
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            np.column_stack(
                [
                    x * radial + p1 * (r2 + 2.0 * x**2) + 2.0 * p2 * x * y,
                    y * radial + p2 * (r2 + 2.0 * y**2) + 2.0 * p1 * x * y,
                ]
            )
            / focus_m
        )

    return fitted_lens("HALCON", size, pinhole, without_polynomial, "polynomial")


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

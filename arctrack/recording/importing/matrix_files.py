"""Rotations and translations from text: blocks of numbers, or OpenCV's YAML and XML."""

import re
from pathlib import Path

import cv2
import numpy as np

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.files import UnfitFileError, blamed_on, read_text
from arctrack.recording.importing.rotations import NoRotationError, rotation_matrices
from noise_model.compiled.arrays import Float64

_SEPARATORS = re.compile(r"[\s,;\[\]]+")
_HOMOGENEOUS = (0.0, 0.0, 0.0, 1.0)

BY_COLUMNS = "the matrices stand column by column, and are read so"


def read_matrices(rotations: Path, translations: Path | None, mm: float) -> tuple[Float64, tuple[str, ...]]:
    """Return poses (n, 4, 4), mm, and notes, of rotations and translations, or of whole poses in one file.

    Without `translations` the matrices are 4 x 4 or 3 x 4, else 3 x 3, row by row. Whole poses may stand
    column by column: their last row tells, or that no other reading makes rotations. `mm` is the file's unit
    of length in mm. Raises ArctrackError for other content, a matrix that is no rotation, or another number
    of translations.
    """
    values, width = _numbers(rotations)
    notes: tuple[str, ...] = ()
    if translations is None:
        T_base_tool, notes = _whole_poses(values, width, rotations)
    else:
        if values.size % 9 or width not in (3, 9):
            raise in_file(rotations, f"holds rows of {width} numbers: matrices of 3 x 3 are needed")
        places, _ = _numbers(translations)
        if places.size != values.size // 3:
            raise in_file(
                translations,
                f"holds {places.size} numbers for {values.size // 9} rotations: three for each are needed",
            )
        T_base_tool = np.tile(np.eye(4), (values.size // 9, 1, 1))
        T_base_tool[:, :3, :3] = values.reshape(-1, 3, 3)
        T_base_tool[:, :3, 3] = places.reshape(-1, 3)
    try:
        T_base_tool[:, :3, :3] = rotation_matrices(T_base_tool[:, :3, :3])
    except NoRotationError as error:
        raise in_file(rotations, f"matrix {error.row + 1} {error}") from None
    T_base_tool[:, :3, 3] *= mm
    return T_base_tool, notes


def _whole_poses(values: Float64, width: int, path: Path) -> tuple[Float64, tuple[str, ...]]:
    arrangements: list[tuple[Float64, tuple[str, ...]]] = []
    if width in (4, 16) and values.size % 16 == 0:
        rows = values.reshape(-1, 4, 4)
        arrangements += [(rows, ()), (rows.swapaxes(1, 2), (BY_COLUMNS,))]
    if width in (3, 4, 12) and values.size % 12 == 0:
        last = np.tile(_HOMOGENEOUS, (values.size // 12, 1, 1))
        if width != 3:
            arrangements.append((np.concatenate([values.reshape(-1, 3, 4), last], axis=1), ()))
        if width != 4:
            columns = values.reshape(-1, 4, 3).swapaxes(1, 2)
            arrangements.append((np.concatenate([columns, last], axis=1), (BY_COLUMNS,)))
    whole = [
        (T_base_tool, notes)
        for T_base_tool, notes in arrangements
        if np.allclose(T_base_tool[:, 3], _HOMOGENEOUS, rtol=0.0, atol=1e-9)
        # Rows of three may as well be rotations without their translations.
        and (width != 3 or _are_rotations(T_base_tool))
    ]
    if not whole:
        raise in_file(
            path,
            f"holds rows of {width} numbers: poses of 4 x 4 are needed, their last row 0 0 0 1, or of 3 x 4, "
            "or --translations beside matrices 3 x 3",
        )
    T_base_tool, notes = next((each for each in whole if _are_rotations(each[0])), whole[0])
    return T_base_tool.copy(), notes


def _are_rotations(T_base_tool: Float64) -> bool:
    try:
        rotation_matrices(T_base_tool[:, :3, :3])
    except NoRotationError:
        return False
    return True


def _numbers(path: Path) -> tuple[Float64, int]:
    """Return the numbers of a file, flat, and how many stand in a row; ArctrackError if it has none."""
    with blamed_on(path):
        text = read_text(path, LIMITS.csv_bytes)
        values, width = _opencv(text) if text.startswith(("%YAML", "<?xml")) else _plain(text)
        if not np.isfinite(values).all():
            raise UnfitFileError("holds a number that is not finite")
    return values, width


def _opencv(text: str) -> tuple[Float64, int]:
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = [storage.getNode(name) for name in list(storage.root().keys())]
        matrices = [node.mat() for node in nodes if node.isMap()]
    except (cv2.error, SystemError):
        raise UnfitFileError("is no valid file of OpenCV's") from None
    matrices = [matrix for matrix in matrices if matrix is not None and matrix.size]
    if not matrices:
        raise UnfitFileError("holds no matrix")
    return np.concatenate([matrix.astype(np.float64).ravel() for matrix in matrices]), matrices[0].shape[-1]


def _plain(text: str) -> tuple[Float64, int]:
    rows: list[list[float]] = []
    for line, content in enumerate(text.splitlines(), 1):
        words = [word for word in _SEPARATORS.split(content.partition("#")[0]) if word]
        try:
            row = [float(word) for word in words]
        except ValueError:
            raise UnfitFileError("holds text where numbers are needed", line) from None
        if row and rows and len(row) != len(rows[0]):
            raise UnfitFileError(f"has {len(row)} numbers where the first row has {len(rows[0])}", line)
        if row:
            rows.append(row)
    if not rows:
        raise UnfitFileError("holds no numbers")
    return np.array(rows).ravel(), len(rows[0])

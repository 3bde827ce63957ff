"""A board as its maker states it: kind, counts, sizes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import cv2
import numpy as np

from noise_model.compiled.arrays import Float64

FORMS = (
    "chessboard:COLUMNSxROWS:SQUAREmm (inner corners) or "
    "charuco:COLUMNSxROWS:SQUAREmm:MARKERmm:DICTIONARY (squares)"
)
"""Notation of a board on a command line."""

MIN_SIDE, MAX_SIDE = 3, 100
"""Inner corners along a side: fewer give no pose, more are no board."""

_SIZE = r"(\d+)x(\d+)"
_LENGTH = r"(\d+(?:\.\d+)?)mm"
_CHESSBOARD = re.compile(rf"chessboard:{_SIZE}:{_LENGTH}", re.IGNORECASE)
_CHARUCO = re.compile(rf"charuco:{_SIZE}:{_LENGTH}:{_LENGTH}:(?:DICT_)?(\w+)", re.IGNORECASE)


class BoardKind(StrEnum):
    """Kind of a board, by how its corners are identified."""

    CHESSBOARD = "chessboard"
    CHARUCO = "charuco"


@dataclass(frozen=True)
class Board:
    """A flat board of squares; its corners are counted row by row, x along the columns, y along the rows.

    `columns` and `rows` count inner corners along x and y. `dictionary` is OpenCV's name of the ArUco
    markers, without DICT_; without markers it is empty and `marker_mm` 0. Raises ValueError for a board that
    cannot be, or a dictionary that OpenCV does not have.
    """

    kind: BoardKind
    columns: int
    rows: int
    square_mm: float
    marker_mm: float = 0.0
    dictionary: str = ""

    def __post_init__(self) -> None:
        if not (MIN_SIDE <= self.columns <= MAX_SIDE and MIN_SIDE <= self.rows <= MAX_SIDE):
            raise ValueError(
                f"{self.columns} x {self.rows} inner corners: a board has {MIN_SIDE} to {MAX_SIDE} each way"
            )
        if not self.square_mm > 0.0:
            raise ValueError("the squares' side must be > 0 mm")
        if self.kind is BoardKind.CHARUCO:
            if not 0.0 < self.marker_mm < self.square_mm:
                raise ValueError("the markers must be smaller than the squares")
            if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
                raise ValueError(f"OpenCV has no dictionary DICT_{self.dictionary}; one is 5X5_100")
            self._check_markers()

    def _check_markers(self) -> None:
        """Raise ValueError if the dictionary has not a marker for every light square."""
        needed = (self.columns + 1) * (self.rows + 1) // 2
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        held = len(dictionary.bytesList)
        if held < needed:
            raise ValueError(f"such a board has {needed} markers, DICT_{self.dictionary} holds {held}")

    @classmethod
    def parse(cls, text: str) -> Board:
        """Return the board that a text such as chessboard:9x6:5mm states; see `FORMS`.

        Raises ValueError if it states none.
        """
        chess, charuco = _CHESSBOARD.fullmatch(text.strip()), _CHARUCO.fullmatch(text.strip())
        if chess is not None:
            return cls(BoardKind.CHESSBOARD, int(chess[1]), int(chess[2]), float(chess[3]))
        if charuco is not None:
            sides = int(charuco[1]) - 1, int(charuco[2]) - 1
            return cls(BoardKind.CHARUCO, *sides, float(charuco[3]), float(charuco[4]), charuco[5].upper())
        raise ValueError(f"{text!r} is no board: it is written as {FORMS}")

    def __str__(self) -> str:
        if self.kind is BoardKind.CHESSBOARD:
            return f"chessboard:{self.columns}x{self.rows}:{self.square_mm:g}mm"
        return (
            f"charuco:{self.columns + 1}x{self.rows + 1}:{self.square_mm:g}mm:{self.marker_mm:g}mm:"
            f"{self.dictionary}"
        )

    @cached_property
    def points_mm(self) -> Float64:
        """The flat corners (columns * rows, 3) from the first one, mm."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        return np.column_stack([column, row, np.zeros(len(row))]) * self.square_mm

    @cached_property
    def bulge(self) -> Float64:
        """Rise of each corner (columns * rows, 2) for a warp of 1 mm along columns and along rows.

        The warped board is z = w_x (1 - x²) + w_y (1 - y²), with x and y from -1 to 1 over it, as in mrcal.
        """
        x, y = self.points_mm[:, 0], self.points_mm[:, 1]
        return np.column_stack([1.0 - (2.0 * x / x.max() - 1.0) ** 2, 1.0 - (2.0 * y / y.max() - 1.0) ** 2])

"""Corners of a board in images, as flat arrays in the order of the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.boards.board import Board
from noise_model.compiled.arrays import Bool, Float64, Int64


@dataclass(frozen=True)
class BoardView:
    """The corners that one image shows: their numbers on the board (n,), and where they are (n, 2), px."""

    name: str
    corners: Int64
    points_px: Float64


@dataclass(frozen=True)
class Sightings:
    """Corners of all images.

    `view` (N,) is each corner's image, in rising order, `corner` (N,) its number on the board, `points_px`
    (N, 2) its position.
    """

    board: Board
    names: tuple[str, ...]
    view: Int64
    corner: Int64
    points_px: Float64

    @classmethod
    def of(cls, board: Board, views: Sequence[BoardView]) -> Sightings:
        """Join the corners of images."""
        counts = [len(view.corners) for view in views]
        return cls(
            board,
            tuple(view.name for view in views),
            np.repeat(np.arange(len(views)), counts),
            np.concatenate([view.corners for view in views]),
            np.concatenate([view.points_px for view in views]).astype(np.float64),
        )

    def __len__(self) -> int:
        return len(self.view)

    @property
    def counts(self) -> Int64:
        """Number of corners in each image."""
        return np.bincount(self.view, minlength=len(self.names))

    @property
    def slices(self) -> list[slice]:
        """Slice of each image's corners."""
        ends = np.cumsum(self.counts)
        return [slice(end - count, end) for end, count in zip(ends, self.counts, strict=True)]

    @property
    def flat_mm(self) -> Float64:
        """Each corner's place (N, 3) on a flat board, mm."""
        return self.board.points_mm[self.corner]

    @property
    def bulge(self) -> Float64:
        """Rise of each corner (N, 2) for a warp of 1 mm each way."""
        return self.board.bulge[self.corner]

    def where(self, kept: Bool) -> Sightings:
        """Return some of the corners; the images stay the same."""
        return replace(self, view=self.view[kept], corner=self.corner[kept], points_px=self.points_px[kept])

    def select_views(self, chosen: Sequence[int] | Int64) -> Sightings:
        """Return the corners of some images, in this order."""
        rows = [np.flatnonzero(self.view == n) for n in chosen]
        picked = np.concatenate(rows)
        return replace(
            self,
            names=tuple(self.names[n] for n in chosen),
            view=np.repeat(np.arange(len(rows)), [len(row) for row in rows]),
            corner=self.corner[picked],
            points_px=self.points_px[picked],
        )

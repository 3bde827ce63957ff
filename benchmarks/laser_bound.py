"""How well boards' corners and stripe points can show a sheet of light at best: Cramer and Rao's bound.

Unknown are the sheet's plane, each board's pose and, where it is not exact, the lens, known by its prior.
Corners scatter independently, the stripe's points alike with their neighbours by an AR(1), which is whitened.
Derivatives are differences. The bound is the inverse of the information for the plane (Van Trees 1968,
Detection, Estimation, and Modulation Theory, 2.4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board
from noise_model.compiled.arrays import Float64

STEP = 1e-6
"""Relative to the unit in which a parameter is of the order of 1."""

LINE_DEGREE = 5
"""The polynomial that a stripe is in the image: a straight line, bent by the lens."""


Project = Callable[[Float64, Float64], Float64]
"""Where points (n, 3) are seen (n, 2), px, through a lens of these values."""

Cross = Callable[[Float64, Rotation, Float64], Float64]
"""Points (n, 3) of the line in which a plane (4,) meets a board of this pose."""


class Seen(NamedTuple):
    """A board's true pose, and the coordinate along the stripe (n,), px, of the stripe's true points."""

    turn: Rotation
    origin: Float64
    along_px: Float64


@dataclass(frozen=True)
class Boards:
    """What is true of a world: its plane (4,), board, lens, and how its images scatter.

    `lens_sigma` is None of a lens that is known. `corner_px` and `point_px` are 1 sigma of corners and stripe
    points, `alike` the correlation of neighbouring points.
    """

    plane: Float64
    board: Board
    lens_values: Float64
    lens_sigma: Float64 | None
    corner_px: float
    point_px: float
    alike: float
    along_rows: bool
    project: Project
    cross: Cross

    def bound(self, seen: Sequence[Seen]) -> Float64:
        """Return the bound of the covariance (4, 4) of the plane n.X + d = 0, mm."""
        distance_mm = float(np.mean([view.origin[2] for view in seen]))
        n_lens = 0 if self.lens_sigma is None else len(self.lens_sigma)
        information = np.diag([*np.zeros(3), *np.ones(n_lens)])
        for view in seen:
            shown = partial(self._whitened, view, distance_mm)
            J = _derivatives(shown, 3 + n_lens + 6)
            shared, pose = J[:, : 3 + n_lens], J[:, 3 + n_lens :]
            # A board's pose is told by its own image alone.
            taken = shared.T @ pose
            information += shared.T @ shared - taken @ np.linalg.solve(pose.T @ pose, taken.T)
        moves = _tangent(self.plane) * [1.0, 1.0, distance_mm]
        return np.asarray(moves @ np.linalg.inv(information)[:3, :3] @ moves.T)

    def _whitened(self, view: Seen, distance_mm: float, off: Float64) -> Float64:
        """Return a view's corners and stripe over their noise, of which plane, lens and pose are off."""
        n_lens = len(off) - 9
        plane = self.plane + _tangent(self.plane) @ (off[:3] * [1.0, 1.0, distance_mm])
        plane /= np.linalg.norm(plane[:3])
        lens = self.lens_values
        if self.lens_sigma is not None:
            lens = lens + self.lens_sigma * off[3 : 3 + n_lens]
        turn = Rotation.from_rotvec(off[-6:-3]) * view.turn
        origin = view.origin + distance_mm * off[-3:]
        corners = self.project(lens, turn.apply(self.board.points_mm) + origin)
        line = self.project(lens, self.cross(plane, turn, origin))
        along, across = line.T if self.along_rows else line.T[::-1]
        middle, half = along.mean(), 0.5 * np.ptp(along)
        curve = np.polynomial.Polynomial.fit((along - middle) / half, across, LINE_DEGREE)
        points = curve((view.along_px - middle) / half)
        new = points[1:] - self.alike * points[:-1]
        own_px = self.point_px * np.sqrt(1.0 - self.alike**2)
        return np.concatenate([corners.ravel() / self.corner_px, points[:1] / self.point_px, new / own_px])


def _tangent(plane: Float64) -> Float64:
    """Return two leans and a move (4, 3) of a plane with a normal of length 1."""
    first = np.linalg.svd(plane[np.newaxis, :3])[2][1]
    basis = np.zeros((4, 3))
    basis[:3, 0], basis[:3, 1], basis[3, 2] = first, np.cross(plane[:3], first), 1.0
    return basis


def _derivatives(function: Callable[[Float64], Float64], n: int) -> Float64:
    """Return a function's derivatives (m, n) where all its parameters (n,) are 0."""
    steps = STEP * np.eye(n)
    return np.column_stack([(function(step) - function(-step)) / (2.0 * STEP) for step in steps])

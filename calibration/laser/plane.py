"""Plane through the lines that a laser sheet makes on boards: errors in all that is measured.

A line's two points P_j lie where their rays r_j meet the board m.X = c: P_j = s_j r_j, s_j = c / (m.r_j).
Their distances from the plane are n.P_j + d. A board that turns by w and moves by t, and a line that shifts
by e across, change them by

    n.r_j [m.t - s_j w.(m x r_j)] / (m.r_j)   and   s_j [n.e - n.r_j (m.e) / (m.r_j)]

to first order, which with the covariances of pose and line gives that of both distances, C. The plane has the
least sum of d' C^-1 d; C is computed again in each round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f

from calibration.laser.image_line import LaserLineFit
from calibration.outliers import FALSE_ALARM, MAX_OUTLIER_SHARE
from noise_model.compiled.arrays import Float64

ROUNDS, SETTLED = 30, 1e-10

MIN_PAIRS = 3
"""Two lines make a plane; the third one says whether it is one."""


@dataclass(frozen=True)
class BoardLine:
    """A stripe's line on a board at `T_camera_board` (4, 4), mm.

    `pose_covariance` (6, 6) is of the board's small motion in the camera frame: a rotation, rad, then a
    translation, mm.
    """

    line: LaserLineFit
    T_camera_board: Float64
    pose_covariance: Float64

    def points(self, rays: Float64) -> Float64:
        """Return the points (n, 3), mm, camera frame, in which rays (n, 3) meet the board."""
        return points_on_board(self.T_camera_board, rays)

    def covariance(self, direction: Float64) -> Float64:
        """Return the covariance (2, 2) of the line's two points along a direction, mm²."""
        m = self.T_camera_board[:3, 2]
        rays, across = self.line.rays, self.line.across
        s = (m @ self.T_camera_board[:3, 3]) / (rays @ m)
        per_depth = rays @ direction / (rays @ m)
        by_pose = per_depth[:, np.newaxis] * np.column_stack(
            [-s[:, np.newaxis] * np.cross(m, rays), np.tile(m, (2, 1))]
        )
        by_line = s * (direction @ across - per_depth * (m @ across))
        return np.asarray(
            by_pose @ self.pose_covariance @ by_pose.T
            + by_line[:, np.newaxis] * self.line.covariance * by_line
        )


@dataclass(frozen=True)
class PlaneFit:
    """A plane n.X + d = 0 of the camera frame: n of length 1, and d, mm.

    `covariance` (4, 4) has rank 3. The normal is known least, with `tilt_sigma` rad, about `loose_axis` (3,),
    a line's direction. `spread_mm` is the RMS scatter of the lines' points, within the plane, about one line
    of that direction, and `spread_noise_mm` that from noise alone. `squares` (k,) are each line's d' C^-1 d.
    """

    plane: Float64
    covariance: Float64
    tilt_sigma: float
    loose_axis: Float64
    spread_mm: float
    spread_noise_mm: float
    squares: Float64

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the sum of squares."""
        return 2 * len(self.squares) - 3


def points_on_board(T_camera_board: Float64, rays: Float64) -> Float64:
    """Return the points (n, 3), mm, camera frame, in which rays (n, 3) meet a board's plane."""
    m = T_camera_board[:3, 2]
    return np.asarray(rays * ((m @ T_camera_board[:3, 3]) / (rays @ m))[:, np.newaxis])


def points_on_plane(plane: Float64, origin: Float64, directions: Float64) -> Float64:
    """Return the points (n, 3) where rays from an origin (3,) along directions (n, 3) meet a plane (4,)."""
    n = plane[:3]
    return np.asarray(origin - ((n @ origin + plane[3]) / (directions @ n))[:, np.newaxis] * directions)


def foot_on(plane: Float64, point: Float64) -> Float64:
    """Return the point (3,) of a plane (4,), n of length 1, that is nearest to another one (3,)."""
    return np.asarray(point - (plane[:3] @ point + plane[3]) * plane[:3])


def fit_plane(lines: Sequence[BoardLine]) -> PlaneFit:
    """Fit a plane to lines on boards.

    Raises numpy.linalg.LinAlgError where they do not determine it at all.
    """
    points = np.stack([line.points(line.line.rays) for line in lines])
    centre = points.mean(axis=(0, 1))
    normal = np.linalg.svd((points - centre).reshape(-1, 3))[2][2]
    offset = 0.0
    for _ in range(ROUNDS):
        basis = np.linalg.svd(normal[np.newaxis])[2][1:]
        H, g, squares = np.zeros((3, 3)), np.zeros(3), []
        for line, pair in zip(lines, points - centre, strict=True):
            distance = pair @ normal + offset
            J = np.column_stack([pair @ basis.T, np.ones(2)])
            C = line.covariance(normal)
            solved = np.linalg.solve(C, np.column_stack([J, distance]))
            H += J.T @ solved[:, :3]
            g += J.T @ solved[:, 3]
            squares.append(float(distance @ solved[:, 3]))
        scale = 1.0 / np.sqrt(np.diag(H))
        small = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
        step = -small @ g
        length = np.sqrt(1.0 + step[:2] @ step[:2])
        normal, offset = (normal + step[:2] @ basis) / length, (offset + step[2]) / length
        if np.abs(step / np.sqrt(np.diag(small))).max() < 1e-6 or np.abs(step).max() < SETTLED:
            break
    d = offset - float(normal @ centre)
    per_small = np.zeros((4, 3))
    per_small[:3, :2], per_small[3, :2], per_small[3, 2] = basis.T, -basis @ centre, 1.0
    variance, turn = np.linalg.eigh(small[:2, :2])
    # The normal tilts along this direction most: it rotates about the one perpendicular to it.
    leaning = turn[:, 1] @ basis
    within = (points - centre).reshape(-1, 3) @ leaning
    noise = np.mean([np.trace(line.covariance(leaning)) for line in lines]) / 2.0
    return PlaneFit(
        np.array([*normal, d]),
        per_small @ small @ per_small.T,
        float(np.sqrt(variance[1])),
        np.cross(normal, leaning),
        float(np.sqrt(np.mean(within**2))),
        float(np.sqrt(noise)),
        np.array(squares),
    )


def consistent(lines: Sequence[BoardLine]) -> list[int]:
    """Return the lines that lie in one plane; the others are left out one by one, the worst first.

    A line's squares and those of the rest about the plane without it are compared by Fisher's F. Its false
    alarm is shared among the lines.
    """
    kept = list(range(len(lines)))
    while len(kept) > MIN_PAIRS + 1 and len(lines) - len(kept) < int(MAX_OUTLIER_SHARE * len(lines)):
        whole = float(fit_plane([lines[n] for n in kept]).squares.sum())
        without = []
        for n in kept:
            try:
                without.append(float(fit_plane([lines[k] for k in kept if k != n]).squares.sum()))
            except np.linalg.LinAlgError:
                without.append(whole)
        best = int(np.argmin(without))
        freedom = 2 * (len(kept) - 1) - 3
        # A set that is as good as its noise is judged by that noise.
        rest = max(without[best] / freedom, 1.0)
        ratio = (whole - without[best]) / 2.0 / rest
        if ratio <= float(f.isf(FALSE_ALARM / len(kept), 2, freedom)):
            break
        kept.pop(best)
    return kept

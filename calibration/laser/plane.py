"""Laser sheet through the stripes on boards, a plane or a cone: errors in all that is measured.

A line's two points P_j lie where their rays r_j meet the board m.X = c: P_j = s_j r_j, s_j = c / (m.r_j).
Their distances from the plane are n.P_j + d. A board that turns by w and moves by t, and a line that shifts
by e across, change them by

    n.r_j [m.t - s_j w.(m x r_j)] / (m.r_j)   and   s_j [n.e - n.r_j (m.e) / (m.r_j)]

to first order, which with the covariances of pose and line gives that of both distances, C. The plane has the
least sum of d' C^-1 d; C is computed again in each round.

A bowed sheet is met by a board in a curve. Three of its points lie n.P_j + d - bow u_j^2 / z_j off the sheet
(`noise_model.instrument.laser.Laser`), and the bow is one more unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f

from calibration.laser.image_line import LaserLineFit
from calibration.outliers import FALSE_ALARM, MAX_OUTLIER_SHARE
from noise_model.compiled.arrays import Float64
from noise_model.instrument.laser import Laser
from noise_model.transforms import invert, transform

ROUNDS, SETTLED = 30, 1e-10

MIN_PAIRS = 3
"""Two lines make a plane; the third one says whether it is one."""


@dataclass(frozen=True)
class BoardLine:
    """A stripe's course on a board at `T_camera_board` (4, 4), mm.

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
        """Return the covariance (k, k) of the course's points along a direction, mm²."""
        m = self.T_camera_board[:3, 2]
        rays, across = self.line.rays, self.line.across
        s = (m @ self.T_camera_board[:3, 3]) / (rays @ m)
        per_depth = rays @ direction / (rays @ m)
        by_pose = per_depth[:, np.newaxis] * np.column_stack(
            [-s[:, np.newaxis] * np.cross(m, rays), np.tile(m, (len(rays), 1))]
        )
        by_line = s * (direction @ across - per_depth * (m @ across))
        return np.asarray(
            by_pose @ self.pose_covariance @ by_pose.T
            + by_line[:, np.newaxis] * self.line.covariance * by_line
        )


@dataclass(frozen=True)
class LaserStand:
    """A laser before the camera: its origin (3,), mm, and the tool's upward axis (3,), camera frame."""

    origin_mm: Float64
    up: Float64

    @classmethod
    def of(cls, laser: Laser, T_tool_camera: Float64) -> LaserStand:
        """Return that of a laser in the tool frame."""
        return cls(transform(invert(T_tool_camera), laser.origin_mm), T_tool_camera[2, :3])

    def rise_mm(self, normal: Float64, points: Float64) -> Float64:
        """Return the distance (n,) of a sheet with a bow of 1 from its plane at points (n, 3)."""
        side = np.cross(self.up, normal)
        away = points - self.origin_mm
        return np.asarray((away @ side) ** 2 / (side @ side) / -(away @ self.up))


@dataclass(frozen=True)
class SheetFit:
    """A sheet of the camera frame: its plane n.X + d = 0, n of length 1 and d in mm, and its bow.

    `covariance` (5, 5) of the five has rank 4, or 3 of a plane, whose bow is 0. The normal is known least,
    with `tilt_sigma` rad, about `loose_axis` (3,), a line's direction. `spread_mm` is the RMS scatter of the
    lines' points, within the plane, about one line of that direction, and `spread_noise_mm` that from noise
    alone. `squares` (k,) are each line's d' C^-1 d, of `freedom` degrees in all.
    """

    plane: Float64
    bow: float
    covariance: Float64
    tilt_sigma: float
    loose_axis: Float64
    spread_mm: float
    spread_noise_mm: float
    squares: Float64
    freedom: int


def points_on_board(T_camera_board: Float64, rays: Float64) -> Float64:
    """Return the points (n, 3), mm, camera frame, in which rays (n, 3) meet a board's plane."""
    m = T_camera_board[:3, 2]
    return np.asarray(rays * ((m @ T_camera_board[:3, 3]) / (rays @ m))[:, np.newaxis])


def points_on_plane(plane: Float64, origin: Float64, directions: Float64) -> Float64:
    """Return the points (n, 3) where rays from an origin (3,) along directions (n, 3) meet a plane (4,)."""
    n = plane[:3]
    return np.asarray(origin - ((n @ origin + plane[3]) / (directions @ n))[:, np.newaxis] * directions)


def points_on_sheet(laser: Laser, origin: Float64, directions: Float64) -> Float64:
    """Return the points (n, 3) where rays from an origin (3,) along directions (n, 3) meet a laser's sheet.

    All in the tool frame. The plane that touches a bowed sheet goes through the laser's origin; Newton's
    steps are those of `noise_model.instrument.laser.plane_met`.
    """
    points = points_on_plane(laser.plane, origin, directions)
    for _ in range(2 if laser.bow else 0):
        normals = laser.normals(points)
        reach = (normals @ (laser.origin_mm - origin)) / np.sum(normals * directions, axis=1)
        points = origin + reach[:, np.newaxis] * directions
    return points


def with_plane(laser: Laser, plane: Float64) -> Laser:
    """Return a laser with another plane (4,), its origin moved into it."""
    x, y, z = foot_on(plane, laser.origin_mm).tolist()
    n_x, n_y, n_z, d_mm = plane.tolist()
    return replace(laser, plane_in_tool=(n_x, n_y, n_z, d_mm), origin_in_tool_mm=(x, y, z))


def foot_on(plane: Float64, point: Float64) -> Float64:
    """Return the point (3,) of a plane (4,), n of length 1, that is nearest to another one (3,)."""
    return np.asarray(point - (plane[:3] @ point + plane[3]) * plane[:3])


def fit_sheet(lines: Sequence[BoardLine], stand: LaserStand | None = None) -> SheetFit:
    """Fit a plane to lines on boards, or with the laser's stand a bowed sheet to parabolas.

    Raises numpy.linalg.LinAlgError where they do not determine it at all.
    """
    places = np.stack([line.points(line.line.rays) for line in lines])
    centre = places.mean(axis=(0, 1))
    normal = np.linalg.svd((places - centre).reshape(-1, 3))[2][2]
    offset, bow, unknowns = 0.0, 0.0, 3 if stand is None else 4
    for _ in range(ROUNDS):
        basis = np.linalg.svd(normal[np.newaxis])[2][1:]
        H, g, squares = np.zeros((unknowns, unknowns)), np.zeros(unknowns), []
        for line, place in zip(lines, places, strict=True):
            distance = (place - centre) @ normal + offset
            J = np.column_stack([(place - centre) @ basis.T, np.ones(len(place))])
            if stand is not None:
                rise = stand.rise_mm(normal, place)
                distance, J = distance - bow * rise, np.column_stack([J, -rise])
            C = line.covariance(normal)
            solved = np.linalg.solve(C, np.column_stack([J, distance]))
            H += J.T @ solved[:, :-1]
            g += J.T @ solved[:, -1]
            squares.append(float(distance @ solved[:, -1]))
        scale = 1.0 / np.sqrt(np.diag(H))
        small = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
        step = -small @ g
        length = np.sqrt(1.0 + step[:2] @ step[:2])
        normal, offset = (normal + step[:2] @ basis) / length, (offset + step[2]) / length
        bow += float(step[3:].sum())
        if np.abs(step / np.sqrt(np.diag(small))).max() < 1e-6 or np.abs(step).max() < SETTLED:
            break
    d = offset - float(normal @ centre)
    per_small = np.zeros((5, unknowns))
    per_small[:3, :2], per_small[3, :2], per_small[3, 2] = basis.T, -basis @ centre, 1.0
    per_small[4, 3:] = 1.0
    variance, turn = np.linalg.eigh(small[:2, :2])
    # The normal tilts along this direction most: it rotates about the one perpendicular to it.
    leaning = turn[:, 1] @ basis
    within = (places - centre).reshape(-1, 3) @ leaning
    noise = np.mean([np.diag(line.covariance(leaning)) for line in lines])
    return SheetFit(
        plane=np.array([*normal, d]),
        bow=bow,
        covariance=per_small @ small @ per_small.T,
        tilt_sigma=float(np.sqrt(variance[1])),
        loose_axis=np.cross(normal, leaning),
        spread_mm=float(np.sqrt(np.mean(within**2))),
        spread_noise_mm=float(np.sqrt(noise)),
        squares=np.array(squares),
        freedom=places.shape[0] * places.shape[1] - unknowns,
    )


def consistent(lines: Sequence[BoardLine], stand: LaserStand | None = None) -> list[int]:
    """Return the lines that lie in one sheet; the others are left out one by one, the worst first.

    A line's squares and those of the rest about the sheet without it are compared by Fisher's F. Its false
    alarm is shared among the lines.
    """
    kept = list(range(len(lines)))
    while len(kept) > MIN_PAIRS + 1 and len(lines) - len(kept) < int(MAX_OUTLIER_SHARE * len(lines)):
        whole = fit_sheet([lines[n] for n in kept], stand)
        total, without = float(whole.squares.sum()), []
        for n in kept:
            try:
                without.append(float(fit_sheet([lines[k] for k in kept if k != n], stand).squares.sum()))
            except np.linalg.LinAlgError:
                without.append(total)
        best = int(np.argmin(without))
        each = len(lines[0].line.rays)
        freedom = whole.freedom - each
        # A set that is as good as its noise is judged by that noise.
        rest = max(without[best] / freedom, 1.0)
        ratio = (total - without[best]) / each / rest
        if ratio <= float(f.isf(FALSE_ALARM / len(kept), each, freedom)):
            break
        kept.pop(best)
    return kept

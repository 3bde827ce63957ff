"""Triangulation: the stripe's points in the tool frame and beside the joint, with what each can move by."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.arc_map import Scene
from noise_model.faces import ridge
from noise_model.frames import Float64
from noise_model.kernel import kernel
from tracker.geometry import Float32, SensorGeometry


@dataclass(frozen=True)
class Profile:
    """The measured cross-section in the joint frame, in order of y; n points.

    `y_mm`, `z_mm` (n,): the points, a corrugation's height taken off z; `dy_mm`, `dz_mm` (n,): how a point
    moves when its stripe centre moves by 1 px; `sigma_px` (n,): that centre's 1 sigma. `column_mm` is the
    points' spacing in y, `scan` (n,) the scan lines they came from. The seam is looked for within
    `reach_mm` of y = 0.
    """

    y_mm: Float64
    z_mm: Float64
    dy_mm: Float64
    dz_mm: Float64
    sigma_px: Float64
    scan: Float64
    column_mm: float
    reach_mm: float = math.inf


def triangulate(
    geometry: SensorGeometry,
    view: Scene,
    position_px: Float64,
    sigma_px: Float64,
) -> Profile:
    """Return the profile of a stripe given per scan line (n_scan,), NaN where there is none.

    The camera's ray through the stripe's centre meets the laser plane in the point; the same half a pixel
    further says how the point moves with the centre, which is all its first-order covariance. Rays between
    two pixels are taken from theirs. `view` should run along the seam as it is expected, for a section seen
    askew is another section.
    """
    n_scan = len(position_px)
    points, scan = np.empty((5, n_scan)), np.empty(n_scan, dtype=np.int64)
    T_joint_camera = view.T_joint_camera
    plane_tool = np.asarray(geometry.setup.laser.plane_in_tool)
    normal = view.T_joint_tool[:3, :3] @ plane_tool[:3]
    plane_joint = np.append(normal, plane_tool[3] - normal @ view.T_joint_tool[:3, 3])
    n = _triangulate(
        geometry.xy,
        position_px,
        sigma_px,
        np.ascontiguousarray(T_joint_camera[:3, :3]),
        np.ascontiguousarray(T_joint_camera[:3, 3]),
        plane_joint,
        view.shape.corrugation,
        points,
        scan,
    )
    y, z, dy, dz, sigma = points[:, :n]
    if (y[1:] < y[:-1]).any():
        order = np.argsort(y, kind="stable")
        y, z, dy, dz, sigma = points[:, order]
        scan[:n] = scan[order]
    column = float(np.median(np.diff(y))) if n > 1 else np.nan
    return Profile(y, z, dy, dz, sigma, scan[:n].astype(np.float64), column)


@kernel
def _meet(
    x: float, y: float, R: Float64, origin: Float64, plane: Float64, corrugation: Float64
) -> tuple[float, float]:
    """Return (y, z), mm, joint frame, where a ray (x, y, 1) meets a plane, less a corrugation's height."""
    d_x, d_y = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2]
    d_z = R[2, 0] * x + R[2, 1] * y + R[2, 2]
    towards = plane[0] * d_x + plane[1] * d_y + plane[2] * d_z
    off = plane[0] * origin[0] + plane[1] * origin[1] + plane[2] * origin[2] + plane[3]
    # A ray that runs away from the plane meets it nowhere.
    t = -off / towards if towards != 0.0 else -1.0
    if not t > 0.0:
        return np.nan, np.nan
    height = ridge(origin[0] + t * d_x, corrugation)[0] if corrugation[0] > 0.0 else 0.0
    return origin[1] + t * d_y, origin[2] + t * d_z - height


@kernel
def _triangulate(
    xy: Float32,
    position_px: Float64,
    sigma_px: Float64,
    R: Float64,
    origin: Float64,
    plane: Float64,
    corrugation: Float64,
    points: Float64,
    scan: npt.NDArray[np.int64],
) -> int:
    """Write y, z, dy, dz and sigma (5, n) of the scan lines that hold a point, and those; return how many."""
    n_scan = len(position_px)
    n_pos = len(xy) // n_scan
    n = 0
    for s in range(n_scan):
        if np.isnan(position_px[s]):
            continue
        # The centre, and half a pixel before and after.
        y_at, z_at, y_before, z_before, y_after, z_after = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for which in range(3):
            position = position_px[s] + 0.5 * (which - 1)
            first = min(max(int(position), 0), n_pos - 2)
            share, pixel = position - first, s * n_pos + first
            x = xy[pixel, 0] + share * (xy[pixel + 1, 0] - xy[pixel, 0])
            y = xy[pixel, 1] + share * (xy[pixel + 1, 1] - xy[pixel, 1])
            met_y, met_z = _meet(x, y, R, origin, plane, corrugation)
            if which == 0:
                y_before, z_before = met_y, met_z
            elif which == 1:
                y_at, z_at = met_y, met_z
            else:
                y_after, z_after = met_y, met_z
        if np.isnan(y_before) or np.isnan(y_after):
            continue
        points[0, n], points[1, n] = y_at, z_at
        points[2, n], points[3, n] = y_after - y_before, z_after - z_before
        points[4, n] = sigma_px[s]
        scan[n] = s
        n += 1
    # In order of y if the image shows it from the other side.
    flips = n > 1 and points[0, 0] > points[0, n - 1]
    for i in range(n // 2 if flips else 0):
        j = n - 1 - i
        scan[i], scan[j] = scan[j], scan[i]
        for row in range(5):
            points[row, i], points[row, j] = points[row, j], points[row, i]
    return n

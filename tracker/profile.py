"""Triangulation: the stripe's points in the tool frame and beside the joint, with what each can move by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from noise_model.arc_map import Scene
from noise_model.frames import Float64, transform
from noise_model.surface import corrugation_height
from tracker.geometry import SensorGeometry, to_laser_plane


@dataclass(frozen=True)
class Profile:
    """The measured cross-section in the joint frame, in order of y; n points.

    `y_mm`, `z_mm` (n,): the points, a corrugation's height taken off z; `dy_mm`, `dz_mm` (n,): how a point
    moves when its stripe centre moves by 1 px; `sigma_px` (n,): that centre's 1 sigma. `column_mm` is the
    points' spacing in y, `scan` (n,) the scan lines they came from.
    """

    y_mm: Float64
    z_mm: Float64
    dy_mm: Float64
    dz_mm: Float64
    sigma_px: Float64
    scan: Float64
    column_mm: float


def triangulate(
    geometry: SensorGeometry,
    view: Scene,
    position_px: Float64,
    sigma_px: Float64,
) -> Profile:
    """Return the profile of a stripe given per scan line (n_scan,), NaN where there is none.

    The camera's ray through the stripe's centre meets the laser plane in the point; the same half a pixel
    further says how the point moves with the centre, which is all its first-order covariance. `view` should
    run along the seam as it is expected, for a section seen askew is another section.
    """
    scan = np.flatnonzero(np.isfinite(position_px)).astype(np.float64)
    position, sigma = position_px[scan.astype(int)], sigma_px[scan.astype(int)]
    points = []
    for shift in (-0.5, 0.0, 0.5):
        points_tool, _ = to_laser_plane(geometry.setup, geometry.image_points(scan, position + shift))
        points_joint = transform(view.T_joint_tool, points_tool)
        points_joint[:, 2] -= corrugation_height(points_joint[:, 0], view.shape.corrugation)
        points.append(points_joint)
    before, at, after = points
    good = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    order = np.argsort(at[good, 1], kind="stable")
    move = (after - before)[good][order]
    at = at[good][order]
    column = float(np.median(np.diff(at[:, 1]))) if len(at) > 1 else np.nan
    return Profile(at[:, 1], at[:, 2], move[:, 1], move[:, 2], sigma[good][order], scan[good][order], column)

"""Displacement of the seam by errors of the calibration, over the laser sheet: a polynomial for each error.

An error of lens, camera pose and sheet moves the point that a pixel sees by dp. Of a pinhole before a plane
dp / depth^2 is a polynomial of second order in the ray's coordinates; distortion adds higher orders. So the
covariance of the seam is that of a Gaussian process of finite rank, dp = sum of z_k dp_k with z_k ~ N(0, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.transforms import invert

ORDER = 8
"""Order of the polynomials: a lens' k3 r^7, and one more by the sheet's lean."""

_ORDERS = np.arange(ORDER + 1)
_OF_X, _OF_Y = np.nonzero(np.add.outer(_ORDERS, _ORDERS) <= ORDER)


@dataclass(frozen=True, eq=False)
class CalibrationField:
    """Displacements of points of the laser sheet by independent errors of 1 sigma each.

    `T_camera_tool` (4, 4) is in mm; rays (x, y, 1) count from `middle` (2,) in units of `half` (2,);
    `coefficients` (p, 3 m) are of m errors' dp / depth^2 in the tool frame, 1/mm.
    """

    T_camera_tool: Float64
    middle: Float64
    half: Float64
    coefficients: Float64

    @classmethod
    def fit(
        cls, T_tool_camera: Float64, points_tool: Float64, moves_mm: Float64, max_depth_mm: float
    ) -> CalibrationField:
        """Fit displacements (n, m, 3) of points (n, 3), tool frame, mm, up to a depth from the camera.

        They are NaN everywhere where no point is that near.
        """
        T_camera_tool = invert(T_tool_camera)
        seen = points_tool @ T_camera_tool[:3, :3].T + T_camera_tool[:3, 3]
        # Towards the sheet's horizon errors have no limit.
        is_met = (seen[:, 2] < max_depth_mm) & np.isfinite(moves_mm).all(axis=(1, 2))
        seen, moves_mm = seen[is_met], moves_mm[is_met]
        if not len(seen):
            unknown = np.full((len(_OF_X), 3 * moves_mm.shape[1]), np.nan)
            return cls(T_camera_tool, np.zeros(2), np.ones(2), unknown)
        rays = seen[:, :2] / seen[:, 2:]
        low, high = (limit(rays, axis=0, initial=0.0) for limit in (np.min, np.max))
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        terms = _terms((rays - middle) / half)
        wanted = moves_mm.reshape(len(seen), -1) / seen[:, 2:] ** 2
        return cls(T_camera_tool, middle, half, np.asarray(np.linalg.lstsq(terms, wanted)[0]))

    def moves_mm(self, point_tool: Float64) -> Float64:
        """Return the displacements (m, 3) of a point (3,) of the sheet, tool frame, mm."""
        seen = self.T_camera_tool[:3, :3] @ point_tool + self.T_camera_tool[:3, 3]
        terms = _terms((seen[:2] / seen[2] - self.middle) / self.half)
        return np.asarray(seen[2] ** 2 * (terms @ self.coefficients)).reshape(-1, 3)


def _terms(ray: Float64) -> Float64:
    powers = ray[..., np.newaxis] ** _ORDERS
    return np.asarray(powers[..., 0, _OF_X] * powers[..., 1, _OF_Y])

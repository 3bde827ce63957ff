"""The lens that is estimated: OpenCV's pinhole with as many of its distortion's coefficients as are free."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from noise_model.calibration_errors import OPENCV, PINHOLE
from noise_model.compiled.arrays import Float64
from noise_model.instrument.camera import undistorted_rays

TILT = ("tau_x", "tau_y")

ORDERS: dict[str, tuple[str, ...]] = {
    "none": (),
    "k1": ("k1",),
    "k1 k2": ("k1", "k2"),
    "k1 k2 p1 p2": ("k1", "k2", "p1", "p2"),
    "k1 k2 p1 p2 k3": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Distortions to choose from, the leanest first."""

POWERS = {"k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6, "p1": 1, "p2": 1}
"""Powers of the field's radius by which a coefficient shifts a point, as a share of that radius."""

RADIAL_SIGMA, TANGENTIAL_SIGMA = 0.3, 0.01
"""1 sigma of what one coefficient does at the image's corner, as a share of its distance from the middle.

The 5660 rectilinear calibrations of lensfun's database (lensfunpy 1.18, as k1 k2 k3 of a 3:2 image) have
0.09, 0.13 and 0.07 RMS; 99 % of each lie below 0.32, 0.50 and 0.28. It has no p1 and p2: 0.01 is more than
lenses that are mounted straight have.
"""

STEP_SIGMAS = 0.1
"""Steps of the lens in finite differences, in sigmas."""


@dataclass(frozen=True)
class Lens:
    """A lens: image size and free parameters; the others are 0.

    `names` are fx, fy, cx, cy, and OpenCV's free distortion coefficients; `values` (n,) are in px, tilts in
    rad.
    """

    width: int
    height: int
    names: tuple[str, ...]
    values: Float64

    @classmethod
    def simple(cls, width: int, height: int, focal_px: float) -> Lens:
        """Return a lens without distortion that looks through the middle of the image."""
        values = np.array([focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1)])
        return cls(width, height, PINHOLE, values)

    def with_distortion(self, names: tuple[str, ...]) -> Lens:
        """Return the lens with these coefficients free; those that were keep their values, others are 0."""
        kept = dict(zip(self.names, self.values, strict=True))
        free = (*PINHOLE, *names)
        return replace(self, names=free, values=np.array([kept.get(name, 0.0) for name in free]))

    @property
    def matrix(self) -> Float64:
        """The 3x3 intrinsic matrix, px."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Float64:
        """All of OpenCV's coefficients (14,)."""
        full = np.zeros(len(OPENCV))
        full[[OPENCV.index(name) for name in self.names[4:]]] = self.values[4:]
        return full

    @property
    def field_radius(self) -> float:
        """The slope of the ray to the image's corner, without distortion: the same at every image size."""
        return 0.5 * float(np.hypot(self.width / self.values[0], self.height / self.values[1]))

    def prior_precision(self) -> Float64:
        """Return 1 / sigma² (n,) of what lenses are known to be, 0 where nothing is.

        Each coefficient is normal about 0, in units of what it does at the image's corner.
        """
        precision = np.zeros(len(self.names))
        for n, name in enumerate(self.names):
            if name in POWERS:
                sigma = TANGENTIAL_SIGMA if name in ("p1", "p2") else RADIAL_SIGMA
                precision[n] = (self.field_radius ** POWERS[name] / sigma) ** 2
        return precision

    @property
    def is_invertible(self) -> bool:
        """True if the radial distortion increases up to the image's farthest corner."""
        k1, k2, _, _, k3, k4, k5, k6 = self.distortion[:8]
        corners = np.array([[x, y] for x in (0.0, self.width - 1.0) for y in (0.0, self.height - 1.0)])
        reach = float(np.linalg.norm((corners - self.values[2:4]) / self.values[:2], axis=1).max())
        # A distortion that does not reach the corner at twice its distance never does for a real lens.
        r = np.linspace(0.0, 2.0 * reach, 400)
        above, below = (1.0 + r**2 * (a + r**2 * (b + r**2 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = r * above / below
        outside = np.flatnonzero(seen >= reach)
        if not len(outside):
            return False
        inner = slice(0, outside[0] + 1)
        return bool((below[inner] > 0.0).all() and (np.diff(seen[inner]) > 0.0).all())

    def project(self, points_camera: Float64) -> Float64:
        """Return the image points (N, 2), px, of points (N, 3), mm, camera frame."""
        return self.project_with_jacobian(points_camera)[0]

    def derivatives(self, covariance: Float64, made_by: Callable[[Lens], Float64]) -> Float64:
        """Return the derivatives (..., n) of what a lens makes by its values; 0 by those that are exact."""
        columns = []
        for step in STEP_SIGMAS * np.diag(np.sqrt(np.diag(covariance))):
            ahead, behind = (made_by(replace(self, values=self.values + sign * step)) for sign in (1.0, -1.0))
            columns.append((ahead - behind) / (2.0 * (step.sum() or np.inf)))
        return np.stack(columns, axis=-1)

    def project_with_jacobian(self, points_camera: Float64) -> tuple[Float64, Float64, Float64]:
        """Project points (N, 3) of the camera frame, mm, with derivatives.

        Returns the image points (N, 2), px, their derivatives (N, 2, 6) by a small motion of the points in
        the camera frame (rotation vector about the camera's centre, rad, then translation, mm), and those (N,
        2, n) by the lens' free parameters.
        """
        points = np.ascontiguousarray(points_camera, dtype=np.float64).reshape(-1, 1, 3)
        seen, derivatives = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        image = np.asarray(seen, dtype=np.float64)[:, 0]
        jacobian = np.asarray(derivatives, dtype=np.float64).reshape(len(points), 2, -1)
        columns = [6, 7, 8, 9, *(10 + OPENCV.index(name) for name in self.names[4:])]
        return image, jacobian[:, :, :6], jacobian[:, :, columns]

    def rays(self, points_px: Float64) -> Float64:
        """Return the rays (N, 3) of image points (N, 2), px, in the camera frame, with z = 1.

        Newton's steps undo the distortion: OpenCV's fixed points run away where it is strong.
        """
        if len(self.names) == len(PINHOLE):
            xy = (points_px - self.values[2:4]) / self.values[:2]
        else:
            xy = undistorted_rays(points_px, self.matrix, self.distortion)
        return np.column_stack([xy, np.ones(len(points_px))])

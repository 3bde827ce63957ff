"""The lens that is estimated: OpenCV's pinhole with as many of its distortion's coefficients as are free."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from noise_model.arrays import Float64
from noise_model.instrument.camera import undistorted_rays

PINHOLE = ("fx", "fy", "cx", "cy")
OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""OpenCV's distortion in its order; tau_x and tau_y, rad, tilt the sensor."""

TILT = ("tau_x", "tau_y")

ORDERS: dict[str, tuple[str, ...]] = {
    "none": (),
    "k1": ("k1",),
    "k1 k2": ("k1", "k2"),
    "k1 k2 p1 p2": ("k1", "k2", "p1", "p2"),
    "k1 k2 p1 p2 k3": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""The distortions to choose from, the leanest first."""


@dataclass(frozen=True)
class Lens:
    """A lens: the image's size and the values of its free parameters; what is not free is 0.

    Parameters
    ----------
    width, height : int
        The image's size, px.
    names : tuple of str
        fx, fy, cx, cy, and those of OpenCV's distortion coefficients that are free.
    values : array (n,)
        Their values; focal lengths and principal point in px, tilts in rad.
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

    def project(self, points_camera: Float64) -> Float64:
        """Return the image points (N, 2), px, of points (N, 3), mm, camera frame."""
        return self.project_with_jacobian(points_camera)[0]

    def project_with_jacobian(self, points_camera: Float64) -> tuple[Float64, Float64, Float64]:
        """Return where points (N, 3) of the camera frame, mm, are seen, and what that depends on.

        Returns
        -------
        image_px : array (N, 2)
            The image points, px.
        per_motion : array (N, 2, 6)
            Their derivatives by a small motion of the points in the camera frame: a rotation vector about the
            camera's centre, rad, then a translation, mm.
        per_lens : array (N, 2, n)
            Their derivatives by the lens' free parameters.
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

"""Uncertainty of the lens: the covariance of a point's projection, over the image.

Another calibration of the same camera would find another lens, and a camera frame that is turned and moved
a little. Only what such a motion cannot undo is an error. As in mrcal's cross-reprojection, the motion (r, t)
is the one that brings the boards of one solution to those of the other, in least squares of the image:

    (r, t) = A_m^-1 sum D_i df_i,   A_m = sum D_i

With D_i df_i = g_i - B_i' ds of the normal equations, sum g_i is independent of ds. A point p is then seen at
q + Q_s ds + Q_m (r, t), where Q_s and Q_m are its derivatives by lens and motion, so that

    cov q = (Q_s - Q_m A_m^-1 B') S^-1 (Q_s - Q_m A_m^-1 B')' + Q_m A_m^-1 Q_m',   B = sum B_i

The second term is small: all corners together say where the boards are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.camera.lens import Lens
from calibration.camera.normal_equations import NormalEquations, scaled_inverse
from noise_model.compiled.arrays import Float64

GRID = 24
"""Points across the longer side of the image at which the projection is judged."""


@dataclass(frozen=True)
class Knowledge:
    """Information of all corners on lens, warp and the boards' common motion.

    `information` (m, m) is S, of lens, warp and, where unknown, printing errors; `mixed` (m, 6) is B,
    `motion` (6, 6) is A_m.
    """

    information: Float64
    mixed: Float64
    motion: Float64

    @classmethod
    def of(cls, equations: NormalEquations) -> Knowledge:
        """Return the information in normal equations."""
        return cls(equations.information(), equations.mixed.sum(axis=0), equations.motion.sum(axis=0))

    def with_images(self, other: NormalEquations) -> Knowledge:
        """Return the information with further images, whose unknowns are lens and warp alone."""
        more = Knowledge.of(other)
        rest = (0, len(self.information) - len(more.information))
        return Knowledge(
            self.information + np.pad(more.information, (rest, rest)),
            self.mixed + np.pad(more.mixed, (rest, (0, 0))),
            self.motion + more.motion,
        )

    def covariance(self) -> Float64:
        """Return S^-1 (m, m), the covariance of what is shared."""
        return scaled_inverse(self.information)

    def projection_covariance(self, lens: Lens, points_px: Float64, distance_mm: float) -> Float64:
        """Return the covariances (N, 2, 2) of the image points `points_px` (N, 2), px².

        `distance_mm` is along z of the camera; infinite for directions alone.
        """
        rays = lens.rays(points_px)
        is_far = not np.isfinite(distance_mm)
        _, per_motion, per_lens = lens.project_with_jacobian(rays if is_far else rays * distance_mm)
        if is_far:
            # However the camera moves, what is far is seen in the same direction.
            per_motion[:, :, 3:] = 0.0
        frames = scaled_inverse(self.motion)
        pull = per_motion @ (frames @ self.mixed.T)
        own = np.pad(per_lens, ((0, 0), (0, 0), (0, self.mixed.shape[0] - per_lens.shape[2]))) - pull
        return np.asarray(
            own @ self.covariance() @ own.transpose(0, 2, 1)
            + per_motion @ frames @ per_motion.transpose(0, 2, 1)
        )


def image_grid(lens: Lens) -> tuple[Float64, tuple[int, int]]:
    """Return points (N, 2), px, evenly over the image row by row, and how many rows and columns they make."""
    pitch = max(lens.width, lens.height) / GRID
    columns, rows = max(round(lens.width / pitch), 2), max(round(lens.height / pitch), 2)
    x = np.linspace(0.0, lens.width - 1.0, columns)
    y = np.linspace(0.0, lens.height - 1.0, rows)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), (rows, columns)


def rms_sigma(covariance: Float64) -> Float64:
    """Return each point's sigma (N,), px, of covariances (N, 2, 2): the RMS over directions.

    A variance below 0 is one that rounding has eaten up: that point is as good as unknown.
    """
    variance = 0.5 * np.trace(covariance, axis1=1, axis2=2)
    return np.asarray(np.sqrt(np.where(variance > 0.0, variance, np.inf)))

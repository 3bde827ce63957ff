"""Certificate of the seam's absolute position: the covariance of all calibrations, propagated to the seam.

A seam point lies where the pixel's ray meets the laser sheet, carried to the tool frame:

    X = -d r / (n . r),    p = R X + t.

Camera, sheet and hand-eye are calibrated one after the other. What the lens has wrong goes into the sheet and
the hand-eye too, where it partly cancels. Each of these therefore comes with its derivatives by the lens'
values, and the lens' share is carried along all three ways at once.

The pose T that the robot states for a frame is not in p, so its error moves no seam in the tool frame: the
robot's share is what its errors at the boards have made of R and t. It is in the place in base, q = T p. With
xi the small motion of the tool by which a pose is off, a turn w and a move m,

    dq = T (dp + w x p + m).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.camera.lens import Lens
from calibration.rigid import cross_matrices
from noise_model.compiled.arrays import Float64

CAMERA, LASER, HAND_EYE, ROBOT, DELAY = "camera", "laser", "hand-eye", "robot", "delay"

LATERAL, VERTICAL = 1, 2
"""Axes of the tool frame across the seam."""


@dataclass(frozen=True)
class KnownLens:
    """The lens and the covariance (k, k) of its free parameters; zeros where it counts as exact."""

    lens: Lens
    covariance: Float64


@dataclass(frozen=True)
class KnownSheet:
    """Laser sheet n.X + d = 0 (4,), camera frame, mm.

    `covariance` (4, 4) is that of its own measurement with an exact lens; `per_lens` (4, k) are its
    derivatives by the lens' parameters.
    """

    plane: Float64
    covariance: Float64
    per_lens: Float64


@dataclass(frozen=True)
class KnownHandEye:
    """Camera pose `T_tool_camera` (4, 4), mm.

    `covariance` (6, 6) is of a rotation, rad, and a translation, mm, both in the camera's own frame, with an
    exact lens, and `by_robot` (6, 6) the part of it that the robot's errors make; `per_lens` (6, k) are their
    derivatives by the lens' parameters.
    """

    T_tool_camera: Float64
    covariance: Float64
    by_robot: Float64
    per_lens: Float64


@dataclass(frozen=True)
class RobotNoise:
    """1 sigma of the tool's pose about and along each of its axes: a turn, rad, and a move, mm."""

    turn_rad: float
    move_mm: float


@dataclass(frozen=True)
class Certificate:
    """Uncertainty of the seam's position, at points of the laser sheet.

    `points_px` (n, 2) are seen at `points_tool_mm` (n, 3), tool frame. `shares_mm2` has each source's share
    (n, 3, 3) in their covariance, tool frame; shares add up. `pose_mm2` (n, 3, 3) comes on top in base: the
    error of the robot's pose, along the tool's axes.
    """

    points_px: Float64
    points_tool_mm: Float64
    pose_mm2: Float64
    shares_mm2: Mapping[str, Float64] = field(default_factory=dict)

    @property
    def covariance_mm2(self) -> Float64:
        """The points' covariance (n, 3, 3), tool frame."""
        return np.asarray(np.sum([*self.shares_mm2.values()], axis=0))

    @property
    def sigma_mm(self) -> Float64:
        """1 sigma (n, 3) along the tool's axes."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance_mm2, axis1=1, axis2=2)))

    @property
    def pose_sigma_mm(self) -> Float64:
        """1 sigma (n, 3) that the error of the robot's pose adds in base, along the tool's axes."""
        return np.asarray(np.sqrt(np.diagonal(self.pose_mm2, axis1=1, axis2=2)))

    def share_sigma_mm(self, source: str) -> Float64:
        """Return 1 sigma (n, 3) that one source alone makes."""
        return np.asarray(np.sqrt(np.diagonal(self.shares_mm2[source], axis1=1, axis2=2)))

    @property
    def across_sigma_mm(self) -> Float64:
        """1 sigma (n,) of the position across the seam, lateral and vertical together."""
        return np.asarray(np.hypot(self.sigma_mm[:, LATERAL], self.sigma_mm[:, VERTICAL]))

    @property
    def nearest_to_tool(self) -> int:
        """The point nearest to the tool's axis x, along which the seam runs."""
        return int(np.argmin(np.hypot(self.points_tool_mm[:, LATERAL], self.points_tool_mm[:, VERTICAL])))

    @property
    def worst(self) -> int:
        """The point that is known least across the seam."""
        return int(np.argmax(self.across_sigma_mm))

    def without(self, source: str) -> float:
        """Return 1 sigma across the seam at the worst point, mm, were one source exact."""
        kept = {name: share for name, share in self.shares_mm2.items() if name != source}
        return float(replace(self, shares_mm2=kept).across_sigma_mm[self.worst]) if kept else 0.0

    @property
    def weakest(self) -> str:
        """The source whose better measurement would improve the seam's position most."""
        return min(self.shares_mm2, key=self.without)


def certify(
    known_lens: KnownLens,
    sheet: KnownSheet,
    hand_eye: KnownHandEye,
    points_px: Float64,
    robot: RobotNoise = RobotNoise(0.0, 0.0),
    delay_sigma_mm: float = 0.0,
) -> Certificate:
    """Propagate the covariance of all calibrations to image points (n, 2) on the laser sheet: J cov J^T.

    `robot` is the error of the poses that the robot states; `delay_sigma_mm` is 1 sigma of the tool's travel,
    along each axis across the seam, in the unknown delay.
    """
    lens, R = known_lens.lens, hand_eye.T_tool_camera[:3, :3]
    rays = lens.rays(points_px)
    normal, distance = sheet.plane[:3], sheet.plane[3]
    slope = rays @ normal
    depth = -distance / slope
    points = depth[:, np.newaxis] * rays

    # n.X + d = 0 holds for every ray: X dn + dd + n.dX = 0 with dX = depth dr + r ddepth.
    per_plane = -rays[:, :, np.newaxis] * (
        np.column_stack([points, np.ones(len(points))])[:, np.newaxis, :] / slope[:, np.newaxis, np.newaxis]
    )
    across = np.eye(3) - rays[:, :, np.newaxis] * normal / slope[:, np.newaxis, np.newaxis]
    per_ray = depth[:, np.newaxis, np.newaxis] * across
    of_rays = known_lens.lens.derivatives(known_lens.covariance, lambda lens: lens.rays(points_px))
    per_lens = np.einsum("nij,njk->nik", per_ray, of_rays)
    per_pose = np.concatenate(
        [-cross_matrices(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2
    )
    per_lens = per_lens + per_plane @ sheet.per_lens + per_pose @ hand_eye.per_lens

    def share(jacobian: Float64, covariance: Float64) -> Float64:
        turned = R @ jacobian
        return np.asarray(turned @ covariance @ np.swapaxes(turned, 1, 2))

    in_tool = points @ R.T + hand_eye.T_tool_camera[:3, 3]
    lever = cross_matrices(in_tool)
    even = np.broadcast_to(np.eye(3), lever.shape)
    is_across = np.diag([0.0, 1.0, 1.0])
    return Certificate(
        points_px,
        in_tool,
        robot.move_mm**2 * even + robot.turn_rad**2 * (lever @ np.swapaxes(lever, 1, 2)),
        {
            CAMERA: share(per_lens, known_lens.covariance),
            LASER: share(per_plane, sheet.covariance),
            HAND_EYE: share(per_pose, hand_eye.covariance - hand_eye.by_robot),
            ROBOT: share(per_pose, hand_eye.by_robot),
            DELAY: delay_sigma_mm**2 * is_across * even,
        },
    )

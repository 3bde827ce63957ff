"""Certificate of the seam's absolute position: the covariance of all calibrations, propagated to the seam.

Camera, sheet and hand-eye are calibrated one after the other. What the lens has wrong goes into the sheet and
the hand-eye too, where it partly cancels. Each of these therefore comes with its derivatives by the lens'
values, and the lens' share is carried along all three ways at once.

The errors are those of a setup's own values: lens, camera pose, plane in the tool frame, and the way of the
tool in an unknown delay (`noise_model.calibration_errors`). A track's sigma follows from the same covariance.

The pose T that the robot states for a frame is not in a point p of the tool frame, so its error moves no seam
there: the robot's share is what its errors at the boards have made of the camera's pose. It is in the place
in base, q = T p. With the small motion of the tool by which a pose is off, a turn w and a move m,

    dq = T (dp + w x p + m).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.camera.lens import Lens
from calibration.rigid import cross_matrices
from noise_model.calibration_errors import BOW, POSE, SHEET, TOOL, CalibrationCovariance
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from tracker.geometry import calibration_moves

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

    `covariance` (5, 5) is that of plane and bow by their own measurement with an exact lens; `per_lens`
    (5, k) are their derivatives by the lens' parameters.
    """

    plane: Float64
    covariance: Float64
    per_lens: Float64


@dataclass(frozen=True)
class KnownHandEye:
    """Camera pose `T_tool_camera` (4, 4), mm.

    `covariance` (6, 6) is of a rotation, deg, and a translation, mm, both in the camera's own frame, with an
    exact lens, and `by_robot` (6, 6) the part of it that the robot's errors make; `per_lens` (6, k) are their
    derivatives by the lens' parameters.
    """

    T_tool_camera: Float64
    covariance: Float64
    by_robot: Float64
    per_lens: Float64


@dataclass(frozen=True)
class RobotNoise:
    """1 sigma of the tool's pose about and along each of its axes: a turn, deg, and a move, mm."""

    turn_deg: float
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


def covariance_shares(
    known_lens: KnownLens, sheet: KnownSheet, hand_eye: KnownHandEye, delay_sigma_mm: float = 0.0
) -> dict[str, CalibrationCovariance]:
    """Return each source's share in the covariance of a setup's values; shares add up.

    `delay_sigma_mm` is 1 sigma of the tool's travel, along each axis across the seam, in the unknown delay.
    """
    R, t = hand_eye.T_tool_camera[:3, :3], hand_eye.T_tool_camera[:3, 3]
    # n_tool = R n, d_tool = d - t.R n: the sheet is measured before the camera, and moves with it.
    to_tool = np.eye(5)
    to_tool[:3, :3], to_tool[3, :3] = R, -t @ R
    normal = sheet.plane[:3]
    with_pose = np.zeros((5, 6))
    with_pose[:3, :3] = -R @ cross_matrices(normal[np.newaxis])[0]
    with_pose[3] = -t @ with_pose[:3]
    with_pose[3, 3:] = -normal
    with_pose[:, :3] *= np.pi / 180.0
    n_lens = len(known_lens.lens.names)
    of_lens = np.vstack(
        [np.eye(n_lens), hand_eye.per_lens, to_tool @ sheet.per_lens + with_pose @ hand_eye.per_lens]
    )
    of_pose = np.vstack([np.zeros((n_lens, 6)), np.eye(6), with_pose])
    of_sheet = np.vstack([np.zeros((n_lens + 6, 5)), to_tool])
    names = (*known_lens.lens.names, *POSE, *SHEET, BOW)

    def share(jacobian: Float64, covariance: Float64) -> CalibrationCovariance:
        return CalibrationCovariance.of(names, jacobian @ covariance @ jacobian.T)

    return {
        CAMERA: share(of_lens, known_lens.covariance),
        LASER: share(of_sheet, sheet.covariance),
        HAND_EYE: share(of_pose, hand_eye.covariance - hand_eye.by_robot),
        ROBOT: share(of_pose, hand_eye.by_robot),
        DELAY: CalibrationCovariance.of(TOOL[1:], delay_sigma_mm**2 * np.eye(2)),
    }


def certify(
    setup: Setup,
    shares: Mapping[str, CalibrationCovariance],
    points_px: Float64,
    robot: RobotNoise = RobotNoise(0.0, 0.0),
) -> Certificate:
    """Propagate the covariance of all calibrations to image points (n, 2) on the laser sheet.

    `robot` is the error of the poses that the robot states.
    """
    joint = CalibrationCovariance.sum(shares.values())
    points, moves_mm = calibration_moves(setup, joint, points_px)
    # All sources by the moves of the joint errors: a track's are the same, and shares add up to them.
    scale = np.sqrt(np.diag(joint.matrix))
    per_value = np.linalg.pinv(joint.modes / scale) @ moves_mm / scale[:, np.newaxis]
    shares_mm2 = {}
    for source, covariance in shares.items():
        known = [name in joint.names for name in covariance.names]
        J = per_value[:, [joint.names.index(name) for name in covariance.names if name in joint.names]]
        shares_mm2[source] = np.swapaxes(J, 1, 2) @ covariance.matrix[np.ix_(known, known)] @ J
    lever = cross_matrices(points)
    turned_mm2 = np.radians(robot.turn_deg) ** 2 * (lever @ np.swapaxes(lever, 1, 2))
    return Certificate(points_px, points, robot.move_mm**2 * np.eye(3) + turned_mm2, shares_mm2)

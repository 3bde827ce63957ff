"""Does the certificate of `arctrack calibrate all` hold, on sensors whose truth is known?

    python benchmarks/calibrate_certificate.py [--worlds N] [--seed SEED]

Random cameras on random robots: the worlds of calibrate_hand_eye.py and calibrate_laser.py, with one lens.
The stated lens is as far off as its covariance says. Hand-eye and sheet are calibrated with it, each from
corners and stripe points of its own. The seam's points over the image are compared with the true ones.
Printed are the bias, the share within the certified 95 % of each axis and within the 95 % ellipse across the
seam, and the square of the error over the certificate. `without cancelling` is what a certificate would say
that took the three as independent.
"""

from __future__ import annotations

from dataclasses import replace

import calibrate_hand_eye as robots
import calibrate_laser as sheets
import numpy as np
from calibration_tally import Tally, judge_worlds
from scipy.stats import chi2

from arctrack.nominal import nominal_setup
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import board_poses
from calibration.camera.lens import Lens
from calibration.certificate import (
    CAMERA,
    Certificate,
    KnownHandEye,
    KnownLens,
    KnownSheet,
    certify,
    covariance_shares,
)
from calibration.hand_eye_boards.calibrate import HandEyeCalibration, calibrate_hand_eye
from calibration.laser.calibrate import LaserCalibration, calibrate_laser
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert

IN_HAND_WRONG_LENS = 8
"""The kind of calibrate_hand_eye's world: in the hand, the lens off, no poses swapped."""

POINTS_PX = np.array([[640.0, 480.0], [160.0, 120.0], [1120.0, 840.0]])
PLACES = ("middle", "upper left", "lower right")
HALF = 1.96
ELLIPSE = float(chi2.isf(0.05, 2))
"""Square of Mahalanobis' distance that 95 % of a plane's errors keep within."""


def seam_points(lens: Lens, plane: Float64, T_tool_camera: Float64) -> Float64:
    """Return where rays through the points meet the sheet (n, 3), tool frame, mm."""
    rays = lens.rays(POINTS_PX)
    points = -plane[3] / (rays @ plane[:3])[:, np.newaxis] * rays
    return np.asarray(points @ T_tool_camera[:3, :3].T + T_tool_camera[:3, 3])


def calibrated(robot: robots.World, sheet: sheets.World) -> tuple[HandEyeCalibration, LaserCalibration]:
    """Return both calibrations with the lens as stated."""
    scene, seen = board_poses(robot.board, robot.views, robot.stated_lens)
    hand_eye = calibrate_hand_eye(
        scene, seen, robot.T_base_tool, is_eye_to_hand=False, lens_covariance=robot.lens_covariance
    )
    scene, seen = board_poses(sheet.board, sheet.views, robot.stated_lens)
    return hand_eye, calibrate_laser(scene, seen, sheet.stripes, sheet.stand, robot.lens_covariance)


def calibrated_setup(hand_eye: HandEyeCalibration, laser: LaserCalibration) -> Setup:
    """Return a setup with the calibrated values."""
    lens, T_tool_camera = laser.lens, hand_eye.T_holder_camera
    nominal = nominal_setup("v_groove", "mild_steel", width=lens.width, height=lens.height)
    fx, fy, cx, cy = lens.values[:4].tolist()
    n_x, n_y, n_z, d_mm = (laser.plane @ invert(T_tool_camera)).tolist()
    camera = replace(
        nominal.camera,
        **{"fx": fx, "fy": fy, "cx": cx, "cy": cy},
        distortion=tuple(lens.distortion.tolist()),
        T_tool_camera=T_tool_camera,
    )
    return replace(nominal, camera=camera, laser=replace(nominal.laser, plane_in_tool=(n_x, n_y, n_z, d_mm)))


def certified(hand_eye: HandEyeCalibration, laser: LaserCalibration, cancels: bool) -> Certificate:
    """Return the certificate; one that does not cancel takes all as independent."""
    keeps = 1.0 if cancels else 0.0
    shares = covariance_shares(
        KnownLens(laser.lens, laser.lens_covariance),
        KnownSheet(
            laser.plane, laser.own_covariance if cancels else laser.covariance, keeps * laser.per_lens
        ),
        KnownHandEye(
            hand_eye.T_holder_camera,
            hand_eye.own_covariance if cancels else hand_eye.covariance,
            hand_eye.by_robot,
            keeps * hand_eye.per_lens,
        ),
    )
    return certify(calibrated_setup(hand_eye, laser), shares, POINTS_PX)


def judge(worlds: int, seed: int) -> None:
    """Calibrate worlds, and print what their certificates are worth."""
    tally, refused = Tally(), 0
    squares: dict[str, list[Float64]] = {"certificate": [], "without cancelling": []}
    lens_mm, others_mm = [], []
    within: dict[str, list[bool]] = {place: [] for place in PLACES}
    for n in range(worlds):
        rng = np.random.default_rng([seed, n])
        robot = robots.draw_world(rng, IN_HAND_WRONG_LENS)
        sheet = sheets.draw_world(rng, with_wrong=n % 2 == 1, with_lens=False, lens=robot.lens)
        try:
            hand_eye, laser = calibrated(robot, sheet)
        except UndeterminedError:
            refused += 1
            continue
        plane = laser.plane * np.sign(laser.plane[:3] @ sheet.plane[:3])
        error = seam_points(laser.lens, plane, hand_eye.T_holder_camera) - seam_points(
            robot.lens, sheet.plane, robot.T_holder_camera
        )
        for name, cancels in (("certificate", True), ("without cancelling", False)):
            sigma = certified(hand_eye, laser, cancels).sigma_mm
            squares[name].extend(((error / sigma) ** 2)[np.isfinite(sigma[:, 0])])
        certificate = certified(hand_eye, laser, cancels=True)
        lens_mm.append(certificate.share_sigma_mm(CAMERA)[0])
        others = replace(
            certificate, shares_mm2={k: v for k, v in certificate.shares_mm2.items() if k != CAMERA}
        )
        others_mm.append(others.sigma_mm[0])
        for k, place in enumerate(PLACES):
            if np.isnan(certificate.points_tool_mm[k, 0]):
                # The ray runs away from the sheet.
                continue
            across_mm, covariance_mm2 = error[k, 1:], certificate.covariance_mm2[k, 1:, 1:]
            within[place].append(bool(across_mm @ np.linalg.solve(covariance_mm2, across_mm) < ELLIPSE))
            for axis, name in enumerate("xyz"):
                off, sigma_mm = float(error[k, axis]), float(certificate.sigma_mm[k, axis])
                tally.add(f"{place}, {name}", off, sigma_mm, abs(off) < HALF * sigma_mm, None)
    print(f"{worlds} worlds, seed {seed}; {refused} of them refused")
    tally.report()
    for place, inside in within.items():
        print(f"{place}: {100.0 * np.mean(inside):.1f} % within the 95 % ellipse across the seam")
    for name, values in squares.items():
        print(
            f"{name}: mean square of error over sigma {np.mean(values):.2f}, median {np.median(values):.2f}"
        )
    print(
        f"1 sigma in the middle, median: lens {np.median(lens_mm):.3f} mm, sheet and hand-eye "
        f"{np.median(others_mm):.3f} mm"
    )


if __name__ == "__main__":
    judge_worlds(judge, __doc__)

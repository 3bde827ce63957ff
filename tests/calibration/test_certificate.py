"""The certificate carries covariances to the seam as samples of all parameters do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from calibration.camera.lens import Lens
from calibration.certificate import (
    CAMERA,
    HAND_EYE,
    LASER,
    ROBOT,
    Certificate,
    KnownHandEye,
    KnownLens,
    KnownSheet,
    RobotNoise,
    certify,
    covariance_shares,
)
from noise_model.calibration_errors import CalibrationCovariance
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from tracker.geometry import SensorGeometry

LENS = Lens(640, 480, ("fx", "fy", "cx", "cy", "k1"), np.array([2190.0, 2188.0, 321.0, 239.0, -0.3]))
NOMINAL = nominal_setup("v_groove", "mild_steel", width=LENS.width, height=LENS.height)
T_TOOL_CAMERA = NOMINAL.camera.T_tool_camera
PLANE = NOMINAL.laser.plane @ T_TOOL_CAMERA
"""In the camera's frame."""

POINTS_PX = np.array([[320.0, 240.0], [50.0, 400.0], [600.0, 80.0]])
SAMPLES = 20_000
EXACT_ROBOT = RobotNoise(0.0, 0.0)


def known(rng: np.random.Generator) -> tuple[KnownLens, KnownSheet, KnownHandEye]:
    def covariance(sigmas: list[float]) -> Float64:
        factor = rng.standard_normal((len(sigmas), len(sigmas)))
        correlation = factor @ factor.T
        scale = np.array(sigmas) / np.sqrt(np.diag(correlation))
        return np.asarray(correlation * np.outer(scale, scale))

    return (
        KnownLens(LENS, covariance([2.0, 2.0, 3.0, 3.0, 0.004])),
        KnownSheet(PLANE, covariance([2e-4, 2e-4, 2e-4, 0.03, 0.0]), 1e-5 * rng.standard_normal((5, 5))),
        KnownHandEye(
            T_TOOL_CAMERA,
            pose := covariance([0.017, 0.017, 0.017, 0.03, 0.03, 0.03]),
            0.5 * pose,
            np.vstack([6e-4 * rng.standard_normal((3, 5)), 0.01 * rng.standard_normal((3, 5))]),
        ),
    )


def stated() -> Setup:
    """A setup with the values of the calibration."""
    fx, fy, cx, cy = LENS.values[:4].tolist()
    distortion = tuple(LENS.distortion[:5].tolist())
    camera = replace(NOMINAL.camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion)
    return replace(NOMINAL, camera=camera)


def certified(
    known_lens: KnownLens,
    sheet: KnownSheet,
    hand_eye: KnownHandEye,
    robot: RobotNoise = EXACT_ROBOT,
) -> Certificate:
    return certify(stated(), covariance_shares(known_lens, sheet, hand_eye), POINTS_PX, robot)


def seam_points(lens: Lens, plane: Float64, T_tool_camera: Float64, motion: Float64) -> Float64:
    """Return where the rays meet the sheet, tool frame, after the camera moved in its own frame."""
    rays = lens.rays(POINTS_PX)
    points = -plane[3] / (rays @ plane[:3])[:, np.newaxis] * rays
    points = points + np.cross(np.radians(motion[:3]), points) + motion[3:]
    return np.asarray(points @ T_tool_camera[:3, :3].T + T_tool_camera[:3, 3])


def sampled(rng: np.random.Generator) -> tuple[Certificate, Float64]:
    """Return a certificate, and the covariance (n, 3, 3) of points whose parameters are drawn."""
    known_lens, sheet, hand_eye = known(rng)
    draws = [
        rng.multivariate_normal(np.zeros(len(each)), each, SAMPLES)
        for each in (known_lens.covariance, sheet.covariance, hand_eye.covariance)
    ]
    points = np.array(
        [
            seam_points(
                replace(LENS, values=LENS.values + lens),
                PLANE + (plane + sheet.per_lens @ lens)[:4],
                hand_eye.T_tool_camera,
                motion + hand_eye.per_lens @ lens,
            )
            for lens, plane, motion in zip(*draws, strict=True)
        ]
    )
    off = points - points.mean(axis=0)
    return certified(known_lens, sheet, hand_eye), np.einsum("sni,snj->nij", off, off) / SAMPLES


@pytest.mark.slow
def test_a_track_has_the_certificates_sigma() -> None:
    shares = covariance_shares(*known(np.random.default_rng(6)), delay_sigma_mm=0.05)
    setup = replace(stated(), calibration=CalibrationCovariance.sum(shares.values()))
    certificate = certify(setup, shares, POINTS_PX)
    field = SensorGeometry.of(setup).calibration_field
    for point, covariance in zip(certificate.points_tool_mm, certificate.covariance_mm2, strict=True):
        moves = field.moves_mm(point)
        np.testing.assert_allclose(moves.T @ moves, covariance, atol=5e-3 * np.trace(covariance))


@pytest.mark.slow
def test_covariances_are_those_of_samples() -> None:
    certificate, covariance = sampled(np.random.default_rng(3))
    scale = np.sqrt(np.einsum("ni,nj->nij", *[np.diagonal(covariance, axis1=1, axis2=2)] * 2))
    np.testing.assert_allclose(certificate.covariance_mm2 / scale, covariance / scale, atol=0.04)


def test_the_weakest_is_the_one_whose_exactness_helps_most() -> None:
    known_lens, sheet, hand_eye = known(np.random.default_rng(4))
    nothing = replace(hand_eye, covariance=1e-6 * hand_eye.covariance, per_lens=0.0 * hand_eye.per_lens)
    nothing = replace(nothing, by_robot=0.0 * hand_eye.by_robot)
    loose = replace(sheet, covariance=100.0 * sheet.covariance)
    assert certified(known_lens, loose, nothing).weakest == LASER
    shaky = 5.0**2 * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    certificate = certified(known_lens, sheet, replace(nothing, covariance=shaky, by_robot=shaky))
    assert certificate.weakest == ROBOT
    total = certificate.across_sigma_mm[certificate.worst]
    assert certificate.without(HAND_EYE) == pytest.approx(total, rel=1e-3)
    assert certificate.without(ROBOT) < 0.5 * total


def test_a_sheet_that_goes_with_the_lens_leaves_depths_alone() -> None:
    """A longer lens sees a point on another ray; a sheet measured by that lens has it at the same depth."""
    known_lens, sheet, hand_eye = known(np.random.default_rng(5))
    points = seam_points(LENS, PLANE, np.eye(4), np.zeros(6))
    step_px, sigma_px = 1e-3, 2.0
    longer = replace(LENS, values=np.array([LENS.values[0] + step_px, *LENS.values[1:]]))
    move_per_px = (longer.rays(POINTS_PX) - LENS.rays(POINTS_PX)) * points[:, 2:] / step_px
    plane_per_lens = np.zeros((5, 5))
    plane_per_lens[:4, 0] = -np.linalg.pinv(np.column_stack([points, np.ones(3)])) @ (move_per_px @ PLANE[:3])
    certificate = certified(
        replace(known_lens, covariance=np.diag([sigma_px**2, 0.0, 0.0, 0.0, 0.0])),
        replace(sheet, per_lens=plane_per_lens),
        replace(hand_eye, per_lens=np.zeros((6, 5))),
    )
    moved_mm = np.sqrt(np.trace(certificate.shares_mm2[CAMERA], axis1=1, axis2=2))
    np.testing.assert_allclose(moved_mm, sigma_px * np.linalg.norm(move_per_px, axis=1), rtol=2e-3)


def test_the_error_of_a_pose_moves_the_seam_in_base_alone() -> None:
    """q = T p with T off by a turn about the tool's z and a move: p stays where it is."""
    exact = certified(*known(np.random.default_rng(6)))
    certificate = certified(*known(np.random.default_rng(6)), RobotNoise(0.5, 0.2))
    np.testing.assert_array_equal(certificate.covariance_mm2, exact.covariance_mm2)
    x, y, z = certificate.points_tool_mm.T
    across_mm2 = 0.2**2 + np.radians(0.5) ** 2 * (np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2]))
    np.testing.assert_allclose(certificate.pose_sigma_mm**2, across_mm2.T)

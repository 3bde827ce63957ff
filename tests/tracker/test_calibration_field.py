"""The field of the calibration's errors: the covariance of points whose setups are drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered import small_setup

from noise_model.calibration_errors import CalibrationCovariance, tool_displacement
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from tracker.geometry import SensorGeometry, to_laser_plane

SIGMAS = {
    **{"fx": 2.0, "fy": 2.0, "cx": 1.5, "cy": 1.5, "k1": 0.02, "k2": 0.1},
    **dict.fromkeys(("rot_x_deg", "rot_y_deg", "rot_z_deg"), 0.05),
    **dict.fromkeys(("move_x_mm", "move_y_mm", "move_z_mm"), 0.1),
    **{"n_x": 1e-3, "n_y": 1e-3, "n_z": 1e-3, "d_mm": 0.2},
    **{"bow": 0.01, "tool_y_mm": 0.1},
}


def calibrated_setup(joint: str, seed: int) -> Setup:
    """A setup with a distorted lens, and errors of all its values that go together."""
    sigma = np.array(list(SIGMAS.values()))
    factor = np.random.default_rng(seed).standard_normal((len(sigma), 6))
    correlation = factor @ factor.T + 0.3 * np.eye(len(sigma))
    scale = sigma / np.sqrt(np.diag(correlation))
    setup = small_setup(joint)
    return replace(
        setup,
        camera=replace(setup.camera, distortion=(-0.3, 0.2, 0.002, -0.001, 0.1)),
        calibration=CalibrationCovariance.of(tuple(SIGMAS), correlation * np.outer(scale, scale)),
    )


def drawn_points(setup: Setup, points_px: Float64, draws: int) -> Float64:
    """Return where image points lie (draws, n, 3), tool frame, as each of the drawn setups has them."""
    covariance = setup.calibration_errors
    rng = np.random.default_rng(2)
    drawn = []
    for values in rng.multivariate_normal(np.zeros(len(covariance.names)), covariance.matrix, draws):
        errors = dict(zip(covariance.names, values.tolist(), strict=True))
        drawn.append(to_laser_plane(setup.with_errors(errors), points_px)[0] + tool_displacement(errors))
    return np.array(drawn)


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_the_covariance_over_the_sheet_is_that_of_drawn_setups(joint: str) -> None:
    setup = calibrated_setup(joint, 1)
    points_px = np.array([[160.0, 120.0], [20.0, 200.0], [300.0, 60.0]])
    field = SensorGeometry.of(setup).calibration_field
    drawn = drawn_points(setup, points_px, 4000)
    for k, point in enumerate(to_laser_plane(setup, points_px)[0]):
        moves = field.moves_mm(point)
        wanted = np.cov(drawn[:, k].T)
        sigma = np.sqrt(np.diag(wanted))
        # Of 4000 draws a correlation's 1 sigma is 0.016.
        np.testing.assert_allclose(moves.T @ moves, wanted, atol=0.08 * np.outer(sigma, sigma).max())


def test_the_polynomials_are_the_moves_between_their_nodes_too() -> None:
    setup = calibrated_setup("v_groove", 3)
    geometry = SensorGeometry.of(setup)
    covariance = setup.calibration_errors
    points_px = np.random.default_rng(1).uniform([0.0, 0.0], [319.0, 239.0], (20, 2))
    errors = covariance.errors(np.eye(len(covariance.modes))[-1])
    there = to_laser_plane(setup.with_errors(errors), points_px)[0] + tool_displacement(errors)
    here = to_laser_plane(setup, points_px)[0]
    found = np.array([geometry.calibration_field.moves_mm(point)[-1] for point in here])
    np.testing.assert_allclose(found, there - here, atol=1e-4 * np.abs(there - here).max())


def test_a_sheet_that_moves_with_the_camera_takes_the_seam_along() -> None:
    setup, off_mm = small_setup("v_groove"), 0.1
    normal_tool = setup.laser.plane[:3]
    along = off_mm * np.append(setup.camera.T_tool_camera[:3, :3].T @ normal_tool, -1.0)
    body = CalibrationCovariance.of(("move_x_mm", "move_y_mm", "move_z_mm", "d_mm"), np.outer(along, along))
    geometry = SensorGeometry.of(replace(setup, calibration=body))
    (move,) = geometry.calibration_field.moves_mm(setup.laser.point_mm)
    np.testing.assert_allclose(np.abs(move), np.abs(off_mm * normal_tool), atol=1e-6)

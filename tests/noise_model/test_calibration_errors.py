"""The joint covariance of a setup's calibrated values, and setups that have such an error."""

from __future__ import annotations

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from noise_model.calibration_errors import POSE, CalibrationCovariance, tool_displacement
from noise_model.setup_keys import Tolerance
from noise_model.transforms import moved


def test_the_modes_of_a_tolerance_are_its_parameters() -> None:
    covariance = CalibrationCovariance.of_tolerance(Tolerance(hand_eye_deg=0.05, hand_eye_mm=0.2))
    assert covariance.names == POSE
    np.testing.assert_allclose(covariance.modes, np.diag([0.05] * 3 + [0.2] * 3))
    exact = CalibrationCovariance.of_tolerance(Tolerance(hand_eye_deg=0.05, hand_eye_mm=0.0))
    assert exact.modes.shape == (3, 6)


def test_modes_are_a_root_of_the_covariance_and_covariances_add_up() -> None:
    rng = np.random.default_rng(1)
    # Of rank 2, with sizes as far apart as px and the distortion's units.
    root = rng.standard_normal((3, 2)) * np.array([[30.0], [1e-7], [1e-3]])
    first = CalibrationCovariance.of(("fx", "k3", "rot_x_deg"), root @ root.T)
    np.testing.assert_allclose(first.modes.T @ first.modes, first.matrix, rtol=1e-6)
    m, some = first.matrix, first.modes_of(("rot_x_deg", "d_mm", "fx"))
    np.testing.assert_allclose(some.T @ some, [[m[2, 2], 0.0, m[2, 0]], [0.0] * 3, [m[0, 2], 0.0, m[0, 0]]])
    second = CalibrationCovariance.of(("rot_x_deg", "d_mm", "n_x"), np.diag([4.0, 9.0, 0.0]))
    both = CalibrationCovariance.sum([first, second])
    assert both.names == ("fx", "k3", "rot_x_deg", "d_mm")
    np.testing.assert_allclose(np.diag(both.matrix), [*np.diag(first.matrix)[:2], first.matrix[2, 2] + 4, 9])


@pytest.mark.parametrize(
    ("names", "rows", "words"),
    [
        (("fx", "fz"), np.eye(2), "'fz' is none of fx"),
        (("fx", "fx"), np.eye(2), "twice"),
        (("fx", "fy"), np.array([[1.0, 2.0], [2.0, 1.0]]), "no negative variance"),
        (("fx", "fy"), np.array([[1.0, 0.5], [0.1, 1.0]]), "symmetric"),
        (("fx",), np.array([[-1.0]]), "no negative variance"),
    ],
)
def test_what_is_no_covariance_is_named(names: tuple[str, ...], rows: np.ndarray, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        CalibrationCovariance.of(names, rows)


def test_errors_change_the_values_that_they_name() -> None:
    setup = nominal_setup("v_groove", "zn_coated", width=320, height=240)
    off = setup.with_errors(
        {"cx": 2.0, "k2": 0.1, "tau_x": 0.01, "rot_y_deg": 0.3, "move_z_mm": 0.4, "n_z": 0.01, "d_mm": -0.5},
    )
    assert off.camera.cx == setup.camera.cx + 2.0
    assert off.camera.fx == setup.camera.fx
    assert off.camera.distortion[1] == pytest.approx(0.1)
    assert off.camera.distortion[12] == pytest.approx(0.01)
    expected = moved(setup.camera.T_tool_camera, [0.0, 0.3, 0.0], [0.0, 0.0, 0.4])
    np.testing.assert_allclose(off.camera.T_tool_camera, expected)
    wanted = setup.laser.plane + np.array([0.0, 0.0, 0.01, -0.5])
    np.testing.assert_allclose(off.laser.plane, wanted / np.linalg.norm(wanted[:3]))
    assert off.laser.plane[:3] @ off.laser.origin_mm + off.laser.plane[3] == pytest.approx(0.0, abs=1e-9)
    assert setup.with_errors({"tool_x_mm": 1.0}).laser == setup.laser
    np.testing.assert_array_equal(tool_displacement({"tool_x_mm": 1.0}), [1.0, 0.0, 0.0])

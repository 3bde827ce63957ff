"""The part of a setup that is off is named by stripes of turned poses, and left open by those of one pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from calibration.check.stripe_place import (
    AS_STATED,
    CAMERA,
    CAMERA_BLOCK,
    LASER,
    OFF_NATS,
    PART,
    RIVAL_NATS,
    SENSOR,
    StripeSight,
    _StripePlaceProblem,
    explain_stripes,
    locate_stripes,
    with_changes,
)
from noise_model.arc.scene import make_scene
from noise_model.calibration_errors import CalibrationCovariance
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import moved
from tracker.geometry import SensorGeometry
from tracker.stripe.expected import expect_stripe

pytestmark = pytest.mark.slow

SETUP = nominal_setup("fillet", "mild_steel", width=320, height=240)
GROOVE = nominal_setup("v_groove", "mild_steel", width=320, height=240)
LYING = SeamLine(y_mm=0.3, z_mm=0.5)
NOISE_PX = 0.2


def poses(turn_deg: float, lift_mm: float) -> list[Float64]:
    rng = np.random.default_rng(3)
    level = np.eye(4)
    level[2, 3] = 1.0
    return [
        moved(level, [*rng.uniform(-turn_deg, turn_deg, 2), 0.0], [5.0 * n, 0.0, rng.uniform(0.0, lift_mm)])
        for n in range(5)
    ]


def sights_of(change: Mapping[str, float], tool: list[Float64], stated: Setup = SETUP) -> list[StripeSight]:
    """Return the stripes that a changed setup makes."""
    rng = np.random.default_rng(1)
    geometry = SensorGeometry.of(with_changes(stated, change))
    sights = []
    for T_base_tool in tool:
        stripe = expect_stripe(geometry, make_scene(geometry.setup, T_base_tool, LYING))
        assert stripe is not None
        position_px = stripe.position_px + rng.normal(0.0, NOISE_PX, geometry.n_scan)
        scan = np.arange(geometry.n_scan, dtype=np.float64)
        sights.append(StripeSight(geometry.image_points(scan, position_px), T_base_tool))
    return sights


def evidences(change: Mapping[str, float], tool: list[Float64], stated: Setup = SETUP) -> dict[str, float]:
    """Return the evidence of each cause of a changed setup's stripes before the stated one."""
    _, causes = explain_stripes(stated, sights_of(change, tool), (AS_STATED, PART, LASER, SENSOR, CAMERA))
    return {cause.name: cause.ln_evidence for cause in causes}


def test_a_sound_setup_explains_stripes_of_a_part_off_its_place() -> None:
    sights = sights_of({}, poses(5.0, 10.0))
    place = locate_stripes(SETUP, sights)
    assert place.as_stated.rms_px < 2.0 * NOISE_PX
    assert (place.seam.y_mm, place.seam.z_mm) == pytest.approx((LYING.y_mm, LYING.z_mm), abs=0.3)
    found = evidences({}, poses(5.0, 10.0))
    assert max(found.values()) < found[AS_STATED] + OFF_NATS


@pytest.mark.parametrize(
    ("change", "right"),
    [
        ({"camera_rot_x": 0.8, "camera_rot_y": 1.0}, CAMERA),
        ({"laser_rot_2": 0.4, "laser_offset": 1.5}, LASER),
        # From the best of the grid alone the fit of so large a change gets stuck.
        ({"camera_rot_x": 1.8, "camera_rot_y": -1.9, "camera_rot_z": 2.0, "camera_y": 8.0}, CAMERA),
    ],
)
def test_turned_poses_name_what_is_off(change: Mapping[str, float], right: str) -> None:
    found = evidences(change, poses(5.0, 10.0))
    assert max(found, key=lambda name: found[name]) == right
    assert found[right] > found[AS_STATED] + OFF_NATS


@pytest.mark.parametrize(
    ("turned_deg", "moved_mm"),
    [((-1.7, -1.0, 1.2), (-1.9, 3.4, 1.8)), ((1.5, -1.9, -1.9), (-5.0, 5.2, -5.5))],
)
def test_a_camera_that_moved_far_is_found_where_plates_alone_do_not_tell_it(
    turned_deg: tuple[float, ...], moved_mm: tuple[float, ...]
) -> None:
    """Plates hide a groove's place: a fit from them alone leaves it beside the stripes."""
    change = dict(zip(CAMERA_BLOCK, (*turned_deg, *moved_mm), strict=True))
    sights = sights_of(change, poses(5.0, 10.0), GROOVE)
    _, causes = explain_stripes(GROOVE, sights, (AS_STATED, LASER, CAMERA))
    best = max(causes, key=lambda cause: cause.ln_evidence)
    assert best.name == CAMERA
    assert best.rms_px < 2.0 * NOISE_PX


def test_the_derivatives_of_one_setup_at_once_are_those_of_each_parameter() -> None:
    problem = _StripePlaceProblem.of(GROOVE, sights_of({}, poses(5.0, 10.0), GROOVE))
    steps = {parameter.name: parameter.step for parameter in problem._parameters(CAMERA)}
    x = dict.fromkeys(steps, 0.0)
    here = problem.residuals(x)
    apart = np.array([(problem.residuals({**x, name: step}) - here) / step for name, step in steps.items()])
    off = np.abs(problem._derivatives(x, steps).T - apart).max(axis=1)
    is_mode = np.array([name in problem.setup.calibration_errors.mode_names for name in steps])
    assert off[~is_mode].max() == 0.0
    # The calibration's errors are moved by a whole sigma: what bends over that is left out.
    assert off[is_mode].max() < 0.01 * np.abs(apart[is_mode]).max()


@pytest.mark.parametrize(("sigma_mm", "explains"), [(1.0, True), (0.01, False)])
def test_a_sheet_is_off_by_what_its_calibration_leaves_open(sigma_mm: float, explains: bool) -> None:
    stated = replace(SETUP, calibration=CalibrationCovariance(("d_mm",), ((sigma_mm**2,),)))
    found = evidences({"laser_offset": 1.5}, poses(5.0, 10.0), stated)
    assert (max(found.values()) < found[AS_STATED] + OFF_NATS) == explains
    assert explains or max(found, key=lambda name: found[name]) == LASER


def test_one_pose_does_not_tell_a_sensor_from_the_part() -> None:
    found = evidences({"sensor_z": 25.0}, poses(0.0, 0.0))
    assert abs(found[SENSOR] - found[PART]) < RIVAL_NATS


def test_a_plane_is_turned_and_moved_as_stated() -> None:
    moved_setup: Setup = with_changes(SETUP, {"laser_offset": 2.0, "laser_rot_2": 1.0})
    before, after = SETUP.laser.plane, moved_setup.laser.plane
    assert np.degrees(np.arccos(before[:3] @ after[:3])) == pytest.approx(1.0, abs=1e-6)
    assert after[:3] @ SETUP.laser.point_mm + after[3] == pytest.approx(-2.0)


def test_nothing_in_the_laser_plane_is_refused() -> None:
    far = StripeSight(np.array([[1e6, 1e6]] * 40), np.eye(4))
    with pytest.raises(ValueError, match="no stripe meets the laser plane"):
        locate_stripes(SETUP, [far])

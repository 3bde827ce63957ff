"""The laser sheet from a flat plate, in simulated worlds whose sheet was displaced."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from plate_scenes import (
    FLAT,
    HEIGHTS,
    HEIGHTS_AND_TILTS,
    LENS,
    MOTIONS,
    ROBOT_MM,
    STATED,
    displaced,
    stripes,
)
from scipy.stats import chi2

from calibration.camera.enough import UndeterminedError
from calibration.certificate import certify
from calibration.gauge.adjustment import Sighting
from calibration.gauge.joint_covariance import sheet_shares
from calibration.gauge.plate import PlateCalibration, calibrate_by_plate, plate_sighting
from calibration.laser.plane import points_on_sheet
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert, moved, transform
from tracker.geometry import to_laser_plane


def scan(
    true: Setup, levels: Sequence[Sequence[float]], rng: np.random.Generator, bend_mm: float = FLAT
) -> list[Sighting]:
    """Return the stripes on a plate as the calibration takes them."""
    shown = stripes(true, levels, rng, bend_mm)
    return [plate_sighting(f"{n}", T, LENS.rays(seen), along_rows=True) for n, (T, seen) in enumerate(shown)]


def errors_of(result: PlateCalibration, true: Setup) -> Float64:
    """Return the errors of leans and place (3,)."""
    state = result.fitted.state
    rows = np.zeros((3, 4))
    rows[:2, :3], rows[2] = state.leans, [*state.centre_mm, 1.0]
    return np.asarray(rows @ (result.plane - true.laser.plane))


@pytest.mark.slow
def test_displaced_sheets_are_found_within_their_sigmas() -> None:
    squares = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = displaced(rng)
        result = calibrate_by_plate(STATED, scan(true, HEIGHTS_AND_TILTS, rng))
        error = errors_of(result, true)
        squares.append(error @ np.linalg.solve(result.tilt_offset_covariance, error))
        assert result.untold == []
        assert np.degrees(result.sigma[:2]).max() < 0.3
        assert result.sigma[2] < 0.4
        assert result.fitted.noise_mm[0] == pytest.approx(ROBOT_MM, rel=0.5)
    # The sum of four chi-squares of three degrees of freedom, 99.9 % to either side.
    assert chi2.ppf(0.001, 12) < sum(squares) < chi2.ppf(0.999, 12)


@pytest.mark.slow
def test_the_motion_that_is_named_tells_what_the_plate_did_not() -> None:
    rng = np.random.default_rng(1)
    true = displaced(rng)
    level = calibrate_by_plate(STATED, scan(true, HEIGHTS[:1], rng), plate_mm=1.0)
    assert level.untold == ["lean about the stripe"]
    named = [HEIGHTS[0], *MOTIONS[level.motions[0]]]
    told = calibrate_by_plate(STATED, scan(true, named, np.random.default_rng(1)), plate_mm=1.0)
    assert told.untold == []
    assert told.sigma[1] < 0.3 * level.sigma[1]


@pytest.mark.slow
def test_what_the_camera_has_wrong_cancels_in_part_at_the_seam() -> None:
    tolerance = STATED.tolerance
    z = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = displaced(rng)
        turn_deg, move_mm = tolerance.hand_eye_deg, tolerance.hand_eye_mm
        pose = moved(
            true.camera.T_tool_camera, turn_deg * rng.standard_normal(3), move_mm * rng.standard_normal(3)
        )
        true = replace(true, camera=replace(true.camera, T_tool_camera=pose))
        result = calibrate_by_plate(STATED, scan(true, HEIGHTS_AND_TILTS, rng))
        by_camera, own = sheet_shares(result, STATED)
        found = replace(STATED, laser=result.fitted.state.laser)
        seen = LENS.project(transform(invert(pose), np.array([[-true.laser.plane[3], 0.0, 0.0]])))
        certificate = certify(found, {"camera": by_camera, "sheet": own}, seen)
        z.append((certificate.points_tool_mm - to_laser_plane(true, seen)[0])[0] / certificate.sigma_mm[0])
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.7


@pytest.mark.slow
def test_stripes_of_something_else_are_named() -> None:
    rng = np.random.default_rng(2)
    true = displaced(rng)
    sightings = scan(true, HEIGHTS_AND_TILTS, rng)
    off = np.add(sightings[3].rays, [0.0, 0.05, 0.0])
    sightings[3] = replace(sightings[3], rays=off)
    result = calibrate_by_plate(STATED, sightings)
    assert list(result.left_out) == ["3"]
    error = errors_of(result, true)
    assert error @ np.linalg.solve(result.tilt_offset_covariance, error) < chi2.ppf(0.999, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("levels", "bend_mm", "why"),
    [
        (HEIGHTS, 4.0, "off one plane, 1 σ: the plate is not flat"),
        (HEIGHTS[:1], FLAT, "the plate says nothing of the sheet: .*the tool by ±15° about its"),
    ],
    ids=["bent", "one height"],
)
def test_a_plate_that_does_not_serve_is_refused(
    levels: Sequence[Sequence[float]], bend_mm: float, why: str
) -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(UndeterminedError, match=why):
        calibrate_by_plate(displaced(rng), scan(displaced(rng), levels, rng, bend_mm))


def test_rays_meet_a_bowed_sheet() -> None:
    laser = replace(STATED.laser, bow=0.15)
    rays = np.array([[-0.1, 0.02, 1.0], [0.08, 0.0, 1.0]]) @ STATED.camera.T_tool_camera[:3, :3].T
    points = points_on_sheet(laser, STATED.camera.T_tool_camera[:3, 3], rays)
    assert laser.off_mm(points) == pytest.approx([0.0, 0.0], abs=1e-4)
    assert np.abs(points @ laser.plane[:3] + laser.plane[3]).max() > 0.05

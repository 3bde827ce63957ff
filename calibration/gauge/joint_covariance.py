"""Joint covariance of camera and sheet where the sheet was found with that camera.

The misfits d(x, c) hang on sheet and gauge x and on what was calibrated before, c: lens, camera pose, bow. If
c is off by e, the least squares move x by -(J' C^-1 J)^-1 J' C^-1 (dd/dc) e. So what camera and sheet have
wrong cancels in part at the seam.
"""

from dataclasses import replace

import numpy as np

from calibration.camera.known_lens import lens_from_camera
from calibration.gauge.adjustment import SHEET, inverse
from calibration.gauge.calibrate import GaugeCalibration
from noise_model.calibration_errors import SHEET as PLANE
from noise_model.calibration_errors import TOOL, CalibrationCovariance
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup

STEP_SIGMAS = 0.01
"""Steps of finite differences, in sigmas of what was calibrated before."""


def sheet_shares(
    result: GaugeCalibration, setup: Setup
) -> tuple[CalibrationCovariance, CalibrationCovariance]:
    """Return the covariance of a setup's values that camera and bow have made, and the sheet's own.

    Both are of camera and sheet; they add up. `setup` is the one by which the sheet was found.
    """
    known = setup.calibration_errors
    kept = [n for n, name in enumerate(known.names) if name not in PLANE]
    names = [known.names[n] for n in kept]
    before = known.matrix[np.ix_(kept, kept)]
    moves = _moves(result, setup, names, np.sqrt(np.diag(before)))
    whole = np.vstack([np.eye(len(names)), result.plane_per_move @ moves])
    by_camera = CalibrationCovariance.of((*names, *PLANE), whole @ before @ whole.T)
    return by_camera, CalibrationCovariance.of(PLANE, result.covariance)


def _moves(result: GaugeCalibration, setup: Setup, names: list[str], sigmas: Float64) -> Float64:
    """Return the derivatives (3, n) of the sheet's leans and place by what was calibrated before."""
    problem, fitted = result.problem, result.fitted
    state, lens = fitted.state, lens_from_camera(setup.camera)
    whitening = problem.whitening(state, fitted.noise_mm)
    misfits, slopes = problem.misfits(state), whitening @ problem.slopes(state)
    changes = np.zeros((len(misfits), len(names)))
    for n, (name, sigma) in enumerate(zip(names, sigmas.tolist(), strict=True)):
        if name in TOOL:
            # The way in an unknown delay is another in each scan.
            continue
        step = STEP_SIGMAS * sigma
        off = setup.with_errors({name: step})
        seen = lens_from_camera(off.camera, lens.names[4:])
        sightings = tuple(
            replace(each, rays=seen.rays(lens.project(each.rays))) for each in problem.sightings
        )
        other = replace(problem, T_tool_camera=off.camera.T_tool_camera, sightings=sightings)
        there = other.misfits(replace(state, laser=replace(state.laser, bow=off.laser.bow)))
        changes[:, n] = (there - misfits) / step
    return np.asarray(-(inverse(fitted.information) @ slopes.T @ whitening @ changes)[SHEET])

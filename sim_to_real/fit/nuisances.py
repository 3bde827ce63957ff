"""The nuisances: values that are off nominal in every recording and are no gap."""

import math
from dataclasses import replace

from noise_model.calibration_errors import POSE
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.fit import Parameter
from noise_model.setup import Setup
from noise_model.transforms import moved
from sim_to_real.data.binned import ObservedRecording

WITHIN_SIGMAS = 4.0
"""Largest error of a nuisance, in tolerances; more is a gap."""

N_LEVELS, N_CAMERA = 3, 6
SEAM_FROM = N_LEVELS + N_CAMERA
"""The first nuisances are levels, then come those of the camera's pose and of the seam.

All but the levels are coefficients of the `SeamCurve`: where the camera is, there its image of the seam is.
"""

BIASED_MEAN_SQUARE = 10.0
"""Mean square of a fit without effects from which the gap has biased its nuisances."""


def nuisances(observed: ObservedRecording) -> tuple[Parameter, ...]:
    """Return the parameters that are off nominal in every recording and are no gap.

    They are one arc level and one laser level for the whole recording, the black level and the camera's pose,
    each within its tolerance; and the seam's departure from where the tracker sees it.
    """
    tolerance = observed.setup.tolerance
    pose_sigmas = observed.setup.calibration_errors.sigmas(POSE).tolist()
    n_own = observed.seam.n_modes - N_CAMERA
    # Finding the seam is daily work: it may lie 30 sigmas off the tracked one.
    return (
        _nuisance("arc_level_ln", "", tolerance.arc_level_rel, 1e-3),
        _nuisance("laser_level_ln", "", tolerance.laser_level_rel, 1e-3),
        _nuisance("black_dn", "DN", tolerance.black_level_dn, 0.01),
        *map(_nuisance, POSE, ["deg"] * 3 + ["mm"] * 3, pose_sigmas, [3e-4] * 3 + [5e-4] * 3),
        *(Parameter(f"seam_{n}", "", 0.0, 1.0, -30.0, 30.0, 0.05) for n in range(n_own)),
    )


def _nuisance(name: str, unit: str, sigma: float, step: float) -> Parameter:
    # A tolerance of 0 would leave no room for a derivative.
    sigma = max(sigma, 1e-6)
    reach = WITHIN_SIGMAS * sigma
    return Parameter(name, unit, 0.0, sigma, -reach, reach, min(step, 0.5 * reach))


def apply_nuisances(stated: Setup, nuisance: Float64) -> Setup:
    """Return the setup with camera and black level as nuisances (p,) say."""
    camera, sensor = stated.camera, stated.sensor
    T_tool_camera = moved(camera.T_tool_camera, nuisance[3:6], nuisance[6:9])
    black_dn = sensor.black_level_dn + float(nuisance[2])
    return replace(
        stated,
        camera=replace(camera, T_tool_camera=T_tool_camera),
        sensor=replace(sensor, black_level_dn=black_dn),
    )


def apply_levels(stated: Condition, nuisance: Float64) -> Condition:
    """Return a condition with the levels as nuisances (p,) say."""
    arc, laser = math.exp(float(nuisance[0])), math.exp(float(nuisance[1]))
    return replace(stated, arc_level=arc * stated.arc_level, laser_level=laser * stated.laser_level)

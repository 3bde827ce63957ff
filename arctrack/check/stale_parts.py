"""Parts of a setup that are not as stated any more: by how much, the cure, and the case without it."""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm

from arctrack.check.check_sample import CheckCase
from arctrack.check.seam_place import SeamPlace
from calibration.check.stripe_place import (
    CAMERA,
    DIMENSION,
    DIMENSION_TOLERANCE,
    DIMENSIONS,
    LASER,
    LENS,
    PART,
    SENSOR,
    Cause,
    with_changes,
)
from noise_model.setup import Setup
from noise_model.transforms import cross

MOVED_PARTS = (PART, LASER, SENSOR, CAMERA)
STALE_PARTS = (*MOVED_PARTS, LENS, DIMENSIONS)

CURES = {
    LASER: "arctrack calibrate sheet corrects it by a scan of any flat plate",
    **dict.fromkeys(
        (SENSOR, CAMERA), "arctrack calibrate hand-eye measures it, in the tool frame that the poses are of"
    ),
    LENS: "recording.toml: give those of arctrack calibrate camera, in px of this image size",
    PART: "touch the plate with the tip: [joint] seam_in_base_mm, the base frame or the tool's length",
    DIMENSIONS: "recording.toml: state the dimensions that the part has",
}


def stale_part(case: CheckCase, cause: Cause, stated: Setup) -> tuple[str, str, CheckCase]:
    """Return what is wrong by a cause, its cure, and the case without it.

    `stated` is the setup as the user states it, which a case may differ from.
    """
    setup = with_changes(case.setup, cause.values)
    if cause.name == PART:
        setup = _with_part_moved(setup, cause)
    return _in_words(stated, setup, cause), CURES[cause.name], case.with_setup(setup)


def _in_words(stated: Setup, setup: Setup, cause: Cause) -> str:
    if cause.name == LENS:
        return f"[camera] fx, fy: about {setup.camera.fx:.0f} px fit, not {stated.camera.fx:.4g}"
    if cause.name == DIMENSIONS:
        changed = [
            f"{name} about {value:.3g}, not {stated.joint.dimensions[name]:g}"
            for name, value in setup.joint.dimensions.items()
            if abs(cause.values.get(DIMENSION + name, 0.0)) > 2.0 * DIMENSION_TOLERANCE
        ]
        return f"[joint] {'; '.join(changed) or 'its dimensions'}"
    size = f"{cause.move_mm:.1f} mm and {cause.turn_deg:.1f}°"
    named = {
        LASER: f"[laser] plane_in_tool is {size} off",
        SENSOR: f"[camera.pose_in_tool] and [laser] plane_in_tool are together {size} off",
        CAMERA: f"[camera.pose_in_tool] is {size} off",
        PART: f"the part's seam lies {SeamPlace(cause.values['seam_y'], cause.values['seam_z'])}",
    }
    return named[cause.name]


def _with_part_moved(setup: Setup, cause: Cause) -> Setup:
    """Return a setup whose nominal seam lies where a cause puts the part."""
    normal = np.asarray(setup.joint.surface_normal_in_base)
    points = np.asarray(setup.joint.seam_in_base_mm)
    to_left = cross(normal, points[-1] - points[0])
    moved = points + cause.values["seam_y"] * to_left / norm(to_left) + cause.values["seam_z"] * normal
    seam = tuple((float(x), float(y), float(z)) for x, y, z in moved)
    return replace(setup, joint=replace(setup.joint, seam_in_base_mm=seam))

"""The profile of an explained frame as the section of a free joint, its seam on the programmed line."""

from collections.abc import Callable

import numpy as np
from skimage.measure import approximate_polygon

from arctrack.errors import in_file
from arctrack.replay.explain import Explanation
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import MAX_SECTION_POINTS
from tracker.joint.type_check import groups_of

simplify: Callable[[Float64, float], Float64] = approximate_polygon


def taught_section(explanation: Explanation) -> str:
    """Return the line of `[joint]` that states a frame's profile as `section_mm`.

    Neighbouring points stand in it as their median, and as few as keep its shape. ArctrackError is raised
    where the frame shows no profile on both sides of the programmed line.
    """
    look, name = explanation.look, f"frame {explanation.frame.index}"
    if look is None or look.profile is None:
        raise in_file(explanation.recording.path, f"{name} shows no profile; choose another frame")
    groups, seam = groups_of(look.profile.points), look.reading.seam
    y_mm, z_mm = np.round(groups.y_mm + seam.y_mm, 3), np.round(groups.z_mm + seam.z_mm, 3)
    rises = np.concatenate([[True], y_mm[1:] > np.maximum.accumulate(y_mm)[:-1]])
    y_mm, z_mm = y_mm[rises], z_mm[rises]
    section, tolerance_mm = np.column_stack([y_mm, z_mm]), 0.01
    while len(section) > MAX_SECTION_POINTS:
        section, tolerance_mm = simplify(section, tolerance_mm), 1.5 * tolerance_mm
    if not y_mm[0] < 0.0 < y_mm[-1]:
        problem = f"{name} shows y from {y_mm[0]:g} to {y_mm[-1]:g} mm, not both sides of the programmed seam"
        raise in_file(explanation.recording.path, f"{problem}; teach [joint] seam_in_base_mm on the part")
    return f"section_mm = {section.tolist()}"

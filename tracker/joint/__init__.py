"""Joint features: from a profile to the seam point, gap and mismatch, one file a shape.

`fit_joint` picks the shape by the setup's joint type.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from noise_model.arrays import Float64, Integers
from noise_model.surface.joint import Joint
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.fillet import fit_fillet
from tracker.joint.groove import fit_groove
from tracker.joint.half_v import fit_half_v
from tracker.joint.image_line import ImageLine
from tracker.joint.lap import fit_lap
from tracker.joint.measured import MeasuredJoint
from tracker.joint.section import Section, frame_given, section_from
from tracker.joint.slot import fit_closed_slot, fit_slot
from tracker.profile import Profile

FITS: Mapping[str, Callable[[Section, StatedJoint], MeasuredJoint]] = {
    "v_groove": fit_groove,
    "u_groove": fit_groove,
    "lap": fit_lap,
    "corrugation": fit_lap,
    "half_v": fit_half_v,
    "fillet": fit_fillet,
}
"""The kernels that measure a joint of a type, whose y is NaN where the section does not determine it."""

SLOTS = frozenset({"butt", "edge"})
"""The types whose kernel, `fit_slot`, takes the frame as well."""

_NOWHERE = np.full(3, math.nan)

__all__ = ["FITS", "MeasuredJoint", "fit_closed_joint", "fit_joint", "fit_section"]


def fit_joint(
    profile: Profile, joint: Joint, camera_mm: Float64 = _NOWHERE, laser_mm: Float64 = _NOWHERE
) -> MeasuredJoint | None:
    """Return the joint that a profile shows, or None where it does not determine one.

    `camera_mm` and `laser_mm` (3,), joint frame: what stands between them and a point hides it. Only an
    upright side does.
    """
    return fit_section(section_from(profile, camera_mm, laser_mm), joint, *frame_given(profile))


def fit_section(section: Section, joint: Joint, image_dn: Integers, along_rows: bool) -> MeasuredJoint | None:
    """Return the joint that a section shows, or None where it does not determine one.

    `image_dn` (H, W) is the frame, whose stripe runs `along_rows`; no pixels where it is not at hand.
    """
    stated = StatedJoint.of(joint)
    if joint.type in FITS:
        fitted = FITS[joint.type](section, stated)
    elif joint.type in SLOTS:
        fitted = fit_slot(section, stated, image_dn, along_rows)
    else:
        return None
    return fitted if fitted.is_determined else None


def fit_closed_joint(profile: Profile, joint: Joint, line: ImageLine) -> MeasuredJoint | None:
    """Return the closed joint that a line in the image shows amid a profile, or None without two plates."""
    section, stated = section_from(profile, _NOWHERE, _NOWHERE), StatedJoint.of(joint)
    fitted: MeasuredJoint = fit_closed_slot(section, stated, line.y_mm, line.sigma_mm, line.evidence_nats)
    return fitted if fitted.is_determined else None

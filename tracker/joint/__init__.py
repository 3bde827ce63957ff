"""Joint features: from a section to the seam point, gap and mismatch, one file a shape.

`fit_section` picks the shape by the setup's joint type.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from noise_model.surface.joint import Joint
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.fillet import fit_fillet
from tracker.joint.free import fit_free
from tracker.joint.groove import fit_groove
from tracker.joint.half_v import fit_half_v
from tracker.joint.image_line import ImageLine
from tracker.joint.lap import fit_lap
from tracker.joint.measured import MeasuredJoint
from tracker.joint.plate_lines import StripeImage
from tracker.joint.slot import fit_closed_slot, fit_slot
from tracker.profile import MIN_POINTS, Section

FITS: Mapping[str, Callable[[Section, StatedJoint], MeasuredJoint | None]] = {
    "v_groove": fit_groove,
    "u_groove": fit_groove,
    "lap": fit_lap,
    "corrugation": fit_lap,
    "half_v": fit_half_v,
    "fillet": fit_fillet,
    "outside_corner": fit_fillet,
    "free": fit_free,
}
"""The fit of a joint of a type, None where the section does not determine it."""

SLOTS = frozenset({"butt", "edge"})
"""The types whose fit, `fit_slot`, takes the frame as well."""

NO_IMAGE = StripeImage(np.empty((0, 0), np.uint8), False, 0)

__all__ = ["FITS", "NO_IMAGE", "MeasuredJoint", "fit_closed_joint", "fit_section"]


def fit_section(section: Section, joint: Joint, image: StripeImage = NO_IMAGE) -> MeasuredJoint | None:
    """Return the joint that a section shows, or None where it does not determine one."""
    if section.points.shape[1] < MIN_POINTS:
        return None
    stated = StatedJoint.of(joint)
    if joint.type in FITS:
        return FITS[joint.type](section, stated)
    return fit_slot(section, stated, image) if joint.type in SLOTS else None


def fit_closed_joint(section: Section, joint: Joint, line: ImageLine) -> MeasuredJoint | None:
    """Return the closed joint that a line in the image shows amid a section, or None without two plates."""
    return fit_closed_slot(section, StatedJoint.of(joint), line.y_mm, line.sigma_mm, line.evidence_nats)

"""A profile as the joints' kernels take it: its points, and what they were read from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from noise_model.arrays import Float64, Integers
from noise_model.kernel import kernel
from tracker.joint.measured import SectionPoints, points_of
from tracker.joint.upright_edge import light_of
from tracker.profile import MIN_POINTS, Profile
from tracker.stripe.light import StripeLight


class Section(NamedTuple):
    """A profile's points (n,) beside the joint; see `Profile`.

    `bias_px` (n,) is empty where centres were not corrected, and `light` where it is not at hand. `camera_mm`
    and `laser_mm` (3,), joint frame, are from where the stripe was seen and lit.
    """

    points: SectionPoints
    column_mm: float
    reach_mm: float
    mixed_mm: float
    slope_sigma: float
    bias_px: Float64
    light: StripeLight
    camera_mm: Float64
    laser_mm: Float64


def section_from(profile: Profile, camera_mm: Float64, laser_mm: Float64) -> Section:
    """Return a profile as the kernels take it, seen and lit from two points (3,), joint frame, mm."""
    return Section(
        points=points_of(profile),
        column_mm=float(profile.column_mm),
        reach_mm=float(profile.reach_mm),
        mixed_mm=float(profile.mixed_mm),
        slope_sigma=float(profile.slope_sigma),
        bias_px=np.empty(0) if profile.bias_px is None else profile.bias_px,
        light=light_of(profile),
        camera_mm=camera_mm,
        laser_mm=laser_mm,
    )


_NO_IMAGE = np.empty((0, 0), np.uint8)


class GivenFrame(NamedTuple):
    """A frame as the sensor gave it (H, W), no pixels where it is not at hand, and how its stripe runs."""

    image_dn: Integers
    along_rows: bool


def frame_given(profile: Profile) -> GivenFrame:
    """Return the frame that a profile was read from."""
    image_dn = profile.image_dn
    if image_dn is None:
        return GivenFrame(_NO_IMAGE, False)
    if image_dn.flags.c_contiguous:
        return GivenFrame(image_dn, False)
    return GivenFrame(np.ascontiguousarray(image_dn.T), True)


@kernel
def is_long_enough(section: Section) -> bool:
    """Say whether a section has as many points as a joint needs."""
    is_long: bool = section.points.y_mm.shape[0] >= MIN_POINTS
    return is_long

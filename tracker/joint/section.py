"""A profile as the joints' kernels take it: its points, and what they were read from."""

from __future__ import annotations

from typing import NamedTuple

from noise_model.arrays import Float64
from tracker.joint.measured import SectionPoints
from tracker.stripe.edge import StripeLight


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

"""Allowed keys of a setup, apart from the physics: known before anything that computes is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

COEFFICIENTS = (5, 8, 14)
"""Numbers of OpenCV's distortion coefficients that a camera may state."""

DIMENSIONS: Mapping[str, tuple[str, ...]] = {
    "flat": (),
    "v_groove": ("included_angle_deg", "depth_mm", "root_gap_mm"),
    "lap": ("thickness_mm",),
    "corrugation": ("thickness_mm", "pitch_mm", "height_mm", "width_mm"),
    "butt": ("gap_mm", "thickness_mm"),
    "fillet": ("included_angle_deg",),
    "half_v": ("bevel_angle_deg", "depth_mm", "root_gap_mm"),
    "u_groove": ("depth_mm", "root_radius_mm", "bevel_angle_deg", "root_gap_mm"),
    "edge": ("gap_mm", "thickness_mm"),
    "outside_corner": ("included_angle_deg",),
    "free": (),
}
"""The dimensions that each type of joint needs."""

OPTIONAL_DIMENSIONS: Mapping[str, tuple[str, ...]] = {"fillet": ("gap_mm",)}
"""The dimensions that a type of joint may have, and has none of where they are not stated."""


@dataclass(frozen=True)
class Tolerance:
    """Tolerances of a careful user's setup: 1 sigma each, except for `seam_mm`.

    Parameters
    ----------
    arc_level_rel, laser_level_rel : float
        The output of arc and laser, relative.
    hand_eye_deg, hand_eye_mm : float
        The camera's pose in the tool frame, degrees and mm.
    black_level_dn : float
        The black level, DN.
    read_noise_rel : float
        The read noise, relative.
    seam_mm : float
        The error that the weld can bear, mm. A track's confidence is the probability that the lateral and the
        vertical error both stay below it.

    Raises
    ------
    ValueError
        For a value below 0.
    """

    arc_level_rel: float = 0.1
    laser_level_rel: float = 0.05
    hand_eye_deg: float = 0.05
    hand_eye_mm: float = 0.05
    black_level_dn: float = 0.3
    read_noise_rel: float = 0.05
    seam_mm: float = 0.25

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0:
                raise ValueError(f"[tolerance] {name} = {value}: must be >= 0")

    def __str__(self) -> str:
        return (
            f"hand-eye {self.hand_eye_deg:g} deg and {self.hand_eye_mm:g} mm, "
            f"arc {100 * self.arc_level_rel:g} %, laser {100 * self.laser_level_rel:g} %; "
            f"the weld bears {self.seam_mm:g} mm"
        )

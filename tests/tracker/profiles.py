"""Profiles cut from a section by rays, as a sensor measures them; they know nothing of the joints' fits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.surface.joint import Joint
from tracker.joint import NO_IMAGE, MeasuredJoint, fit_section
from tracker.joint.plate_lines import StripeImage
from tracker.profile import Section, in_scan_order, points_of
from tracker.state import BIAS_PX, MISFIT_PX, N_LINES
from tracker.stripe.light import NO_LIGHT, StripeLight

COLUMN_MM, PX_MM = 0.07, (0.012, 0.075)
"""The columns' spacing in y, and how far (y, z) a point moves per px of its stripe centre."""

REACH_MM = 18.0

SATURATION_DN = 65_000


NOWHERE = np.full(3, math.nan)


@dataclass(frozen=True)
class Profile:
    """A section whose points (n,) are at hand by name, and the frame by scan line that it was read from."""

    y_mm: Float64
    z_mm: Float64
    dy_mm: Float64
    dz_mm: Float64
    sigma_px: Float64
    scan: Float64
    column_mm: float
    beside_px: Float64
    reach_mm: float = math.inf
    light: StripeLight = NO_LIGHT
    image_dn: Integers | None = None
    mixed_mm: float = 0.0
    bias_px: Float64 | float = 0.0
    misfit_px: Float64 | float = 0.0
    n_lines: Float64 | float = 1.0
    slope_sigma: float = 0.0

    @property
    def points(self) -> Float64:
        """The points as the tracker takes them."""
        points = points_of(
            self.y_mm,
            self.z_mm,
            dy_mm=self.dy_mm,
            dz_mm=self.dz_mm,
            scan=self.scan,
            sigma_px=self.sigma_px,
            beside_px=self.beside_px,
        )
        points[BIAS_PX], points[MISFIT_PX], points[N_LINES] = self.bias_px, self.misfit_px, self.n_lines
        return points

    @property
    def lines_each(self) -> Float64:
        """For how many scan lines each point stands."""
        return self.points[N_LINES]

    @property
    def image(self) -> StripeImage:
        """The frame that it was read from."""
        if self.image_dn is None:
            return NO_IMAGE
        if self.image_dn.flags.c_contiguous:
            return StripeImage(self.image_dn, False, SATURATION_DN)
        return StripeImage(np.ascontiguousarray(self.image_dn.T), True, SATURATION_DN)

    def seen_from(self, camera_mm: Float64 = NOWHERE, laser_mm: Float64 = NOWHERE) -> Section:
        """The section as the tracker takes it."""
        return Section(
            self.points,
            self.column_mm,
            self.reach_mm,
            self.mixed_mm,
            self.slope_sigma,
            light=self.light,
            camera_mm=camera_mm,
            laser_mm=laser_mm,
        )

    def by_scan(self) -> Profile:
        """The profile in order of its scan lines."""
        names = (
            "y_mm",
            "z_mm",
            "dy_mm",
            "dz_mm",
            "scan",
            "sigma_px",
            "beside_px",
            "bias_px",
            "misfit_px",
            "n_lines",
        )
        return replace(self, **dict(zip(names, in_scan_order(self.points), strict=True)))


def fit_joint(
    profile: Profile, joint: Joint, camera_mm: Float64 = NOWHERE, laser_mm: Float64 = NOWHERE
) -> MeasuredJoint | None:
    """The joint that a profile shows, seen and lit from two points (3,)."""
    return fit_section(profile.seen_from(camera_mm, laser_mm), joint, profile.image)


def groove(
    angle_deg: tuple[float, float], depth_mm: tuple[float, float], gap_mm: float, tilt: float = 0.0
) -> Float64:
    """The corners (n, 2) of a V whose left and right sides differ, its root's middle at 0, 0."""
    left, right = (d * math.tan(math.radians(a)) for a, d in zip(angle_deg, depth_mm, strict=True))
    far = 60.0
    corners = [
        (far, depth_mm[0] + tilt * (far - left)),
        (gap_mm / 2.0 + left, depth_mm[0]),
        (gap_mm / 2.0, 0.0),
        (-gap_mm / 2.0, 0.0),
        (-gap_mm / 2.0 - right, depth_mm[1]),
        (-far, depth_mm[1] - tilt * (far - right)),
    ]
    return np.array(corners[::-1])


def lap(step_mm: float, slope_lower: float = 0.0, slope_upper: float = 0.0) -> Float64:
    """The corners of an upper sheet at y < 0 over a lower one, the edge's foot at 0, 0."""
    far = 60.0
    return np.array(
        [(-far, step_mm - far * slope_upper), (0.0, step_mm), (0.0, 0.0), (far, far * slope_lower)]
    )


def rounded(corners: Float64, radius_mm: float) -> Float64:
    """The corners (n, 2) with the metal's own, those that stand out of it, rounded as far as faces allow."""
    inner = []
    for before, corner, behind in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        lengths = np.linalg.norm([before - corner, behind - corner], axis=1)
        towards, onward = (before - corner) / lengths[0], (behind - corner) / lengths[1]
        if radius_mm == 0.0 or towards[0] * onward[1] <= towards[1] * onward[0]:
            inner.append(corner)
            continue
        half = 0.5 * math.acos(float(towards @ onward))
        tangent_mm = min(radius_mm / math.tan(half), 0.9 * lengths.min())
        middle = corner + (towards + onward) / np.linalg.norm(towards + onward) * tangent_mm / math.cos(half)
        turns = np.linspace(half - 0.5 * math.pi, 0.5 * math.pi - half, 13)
        out = (corner - middle) / np.linalg.norm(corner - middle) * tangent_mm * math.tan(half)
        for cos, sin in zip(np.cos(turns), -np.sin(turns), strict=True):
            inner.append(middle + np.array([[cos, -sin], [sin, cos]]) @ out)
    return np.array([corners[0], *inner, corners[-1]])


def measure(
    corners: Float64,
    seam_mm: tuple[float, float],
    rng: np.random.Generator,
    *,
    sigma_px: float = 0.05,
    common_px: float = 0.0,
    noise: bool = True,
    hidden_mm: tuple[float, float] | None = None,
) -> Profile:
    """The points that columns see of a section put at `seam_mm`, each moved along its own ray by the noise.

    A point's stated sigma is `sigma_px`, and `common_px` the 1 sigma of their common error. The profile spans
    REACH_MM to either side of its middle, and what lies in `hidden_mm` beside the seam is not seen.
    """
    y = np.arange(-REACH_MM, REACH_MM, COLUMN_MM) + rng.uniform(0.0, COLUMN_MM)
    if hidden_mm is not None:
        beside = y - seam_mm[0]
        y = y[(beside < hidden_mm[0]) | (beside > hidden_mm[1])]
    z = np.interp(y - seam_mm[0], corners[:, 0], corners[:, 1]) + seam_mm[1]
    error = sigma_px * rng.normal(size=len(y)) if noise else np.zeros(len(y))
    error += common_px * rng.normal() if common_px else 0.0
    y, z = y + PX_MM[0] * error, z + PX_MM[1] * error
    order = np.argsort(y, kind="stable")
    n = np.ones(len(y))
    sigma = sigma_px * n
    return Profile(
        y[order],
        z[order],
        PX_MM[0] * n,
        PX_MM[1] * n,
        sigma,
        np.arange(len(y), dtype=float),
        COLUMN_MM,
        sigma,
    )


def spoil(profile: Profile, share: float, rng: np.random.Generator) -> Profile:
    """Throw a share of the points anywhere within 4 mm of the profile's heights."""
    wrong = rng.random(len(profile.y_mm)) < share
    anywhere = rng.uniform(profile.z_mm.min() - 4.0, profile.z_mm.max() + 4.0, len(profile.y_mm))
    return Profile(
        profile.y_mm,
        np.where(wrong, anywhere, profile.z_mm),
        profile.dy_mm,
        profile.dz_mm,
        profile.sigma_px,
        profile.scan,
        profile.column_mm,
        profile.beside_px,
    )


def only(profile: Profile, seen: Bool) -> Profile:
    """The part of a profile that is seen."""
    return Profile(
        profile.y_mm[seen],
        profile.z_mm[seen],
        profile.dy_mm[seen],
        profile.dz_mm[seen],
        profile.sigma_px[seen],
        profile.scan[seen],
        profile.column_mm,
        profile.beside_px[seen],
    )
